// The analytic room while it is labelled: trained shortly with learned geometry, and seen by views of exact distances.
#pragma once

#include "core/non_copyable.h"
#include "labels/serve/label_loop.h"
#include "surface/surface_graph.h"
#include "tests/analytic_scene.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_loop {

// The analytic room as the views of a labelling session see it, with exact distances: surfaces without a field.

inline RayLimits room_limits() { return RayLimits{.near_m = 0.05, .far_m = 10}; }

inline testkit::AnalyticHit hit_at(const RayCamera& camera, const PixelPlace& pixel) {
  double o[3], d[3], near_far[2];
  cast_ray(camera, room_limits(), pixel.column, pixel.row, o, d, near_far);
  return testkit::intersect_analytic_room({o[0], o[1], o[2]}, {d[0], d[1], d[2]});
}

/// Views of every frame of the room, at a stride.
struct SeenRoom : NonCopyable {
  SceneInfo info;
  std::vector<StoredFrame> photos;
  std::vector<PoolView> views;

  explicit SeenRoom(std::int32_t stride = 2, int frames = 6) {
    testkit::AnalyticSceneOptions options{.frames = frames};
    const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene(options);
    Diagnostics diagnostics;
    info = scene->open(diagnostics);
    photos.reserve(info.frames.size());
    for (std::size_t f = 0; f < info.frames.size(); ++f) {
      FrameBuffer buffer;
      scene->read(static_cast<int>(f), buffer);
      photos.emplace_back(std::move(buffer));
      PoolView view{.frame = static_cast<int>(f),
                    .camera = {info.frames[f].camera, info.frames[f].world_from_camera, false},
                    .photo = &photos.back()};
      SurfaceMap& map = view.map;
      map.stride = stride;
      map.width_px = strided_px(view.camera.camera.width_px, stride);
      map.height_px = strided_px(view.camera.camera.height_px, stride);
      for (std::int64_t i = 0; i < std::int64_t{map.width_px} * map.height_px; ++i) {
        const AnalyticHit hit = hit_at(view.camera, strided_place(i, map.width_px, stride));
        map.distance_m.push_back(static_cast<float>(hit.t_m));
      }
      views.push_back(std::move(view));
    }
  }

 private:
  using AnalyticHit = testkit::AnalyticHit;
};

// The analytic room while it is labelled: a short training whose geometry is learned, and clicks with the true class.

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

inline PointLearning quick_learning() { return PointLearning{.steps = 60, .batch = 128}; }

struct LoopedRoom {
  std::unique_ptr<Trainer> training;
  std::unique_ptr<LabelLoop> loop;

  explicit LoopedRoom(std::int64_t steps = 150, const PointLearning& learning = quick_learning(),
                      const std::string& scene = "analytic_room") {
    Registry& registry = testing_train::all_plugins();
    training = std::make_unique<Trainer>(run_config_of(parse_config_text(room_config(scene), "test.yaml"), registry),
                                         registry);
    loop = std::make_unique<LabelLoop>(*training, training->session().drawn_frames(), learning);
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
