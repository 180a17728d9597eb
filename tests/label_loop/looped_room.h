// The analytic room while it is labelled: a short training whose geometry is learned, and clicks with the true class.
#pragma once

#include "serve/label_loop.h"
#include "tests/label_loop/seen_room.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_loop {

/// With depth images geometry stands after few steps.
inline std::string room_config(const std::string& scene = "analytic_room", const std::string& more = "") {
  std::string yaml =
      testing_train::hash_config("losses: [{type: depth, kind: line_of_sight, weight: 0.3, from_step: 0}]\n" + more);
  yaml.insert(yaml.find("train: "),
              "    semantic: {position: {type: frequency, frequencies: 4}, field: {type: tiny_mlp, hidden_width: 32, "
              "hidden_layers: 2}}\n");
  yaml.replace(yaml.find("analytic_room"), 13, scene);
  return yaml;
}

inline LabelLoopOptions quick_options() { return LabelLoopOptions{.learning = {.steps = 60, .batch = 128}}; }

struct LoopedRoom {
  Registry registry = testing_train::make_registry();
  std::unique_ptr<Training> training;
  std::unique_ptr<LabelLoop> loop;

  explicit LoopedRoom(std::int64_t steps = 150, const LabelLoopOptions& options = quick_options()) {
    training =
        std::make_unique<Training>(run_config_of(parse_config_text(room_config(), "test.yaml"), registry), registry);
    loop = std::make_unique<LabelLoop>(*training, training->session().drawn_frames(), options);
    train(steps);
  }
  /// More steps, and the surfaces that are due then.
  void train(std::int64_t steps) {
    training->train(steps);
    if (steps > 0) (void)loop->update_surfaces(1e9);
  }
  std::int16_t truth(int view, const PixelPlace& pixel) const {
    return static_cast<std::int16_t>(hit_at(loop->views()[view].camera, pixel).label);
  }
  LabelledPixels click(int view, const PixelPlace& pixel) const { return {view, truth(view, pixel), {pixel}}; }
  /// Pixels here and there in the views, each with its true class.
  std::vector<LabelledPixels> clicks(int count, int begin = 0) const {
    std::vector<LabelledPixels> out;
    for (int k = begin; k < begin + count; ++k)
      out.push_back(click(k % static_cast<int>(loop->views().size()), {(17 * k + 5) % 44 + 2, (11 * k + 7) % 32 + 2}));
    return out;
  }
  /// Share of the views' pixels that are named rightly.
  double share_right() const {
    double right = 0, all = 0;
    for (int v = 0; v < std::ssize(loop->views()); ++v) {
      const ViewLabels labels = loop->labels_of(v);
      for (std::int32_t i = 0; i < labels.width_px * labels.height_px; ++i) {
        right += labels.label[i] == truth(v, {i % labels.width_px, i / labels.width_px});
        all += 1;
      }
    }
    return right / all;
  }
  std::uint32_t bits() const { return testing_train::fingerprint(training->session().pipeline->store()); }
};

}  // namespace semfield::testing_loop
