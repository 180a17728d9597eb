// A scene in another unit trains, renders and scores alike: every length is measured in the scene's own extent.
#include <gtest/gtest.h>

#include <cmath>

#include "config/compose.h"
#include "core/text.h"
#include "eval/evaluator.h"
#include "session/trainer.h"
#include "system/checksum.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

/// Settings, and what the analytic room has in them.
struct Case {
  std::string name;
  std::string config;              // a shipped preset, or YAML
  std::string scene;               // of the section, beside its type
  std::vector<std::string> set{};  // makes it small
  bool with_bounds = false;
};

struct Outcome {
  double unit_m = 0;
  std::vector<double> losses;  // of each step
  std::uint32_t learned = 0;   // CRC-32C of the tensors
  std::vector<float> color;    // of a held-out frame
  double depth_m = 0;          // its mean
};

Session open_in_unit(const Case& c, double scale, Registry& registry) {
  const std::string factor = shortest_number(scale);
  std::string lengths = "pose_scale: " + factor + ", depth_scale: " + factor;
  if (c.with_bounds) {  // wider than the dataset's, which are the walls: whether depth lies behind them, rounding says
    lengths += ", bounds: [";
    for (const double at : {-2.1, -1.6, -1.1, 2.1, 1.6, 1.1}) lengths += shortest_number(at * scale) + ", ";
    lengths += "]";
  }
  const ConfigNode scene =
      parse_config_text("scene: {type: analytic_room, " + c.scene + "load: {" + lengths + "}}", "scene");
  ConfigNode tree = c.config.ends_with(".yaml") ? compose_config(c.config, c.set) : parse_config_text(c.config, c.name);
  Diagnostics diagnostics;
  RunConfig config = read_run_config(tree.with("scene", *scene.find("scene")), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, c.name);
  return open_session(std::move(config), registry, {}, diagnostics);
}

Outcome train_in_unit(const Case& c, double scale) {
  static Registry registry = make_registry();
  Session s = open_in_unit(c, scale, registry);
  const auto rays = s.make_ray_source();
  constexpr std::int64_t kSteps = 24;
  Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule, kSteps);
  Outcome out;
  out.unit_m = s.config.rendering.unit_m;
  while (trainer.step() < kSteps) {
    const StepLosses losses = trainer.advance();
    for (const double loss : {losses.total, losses.color, losses.semantic}) out.losses.push_back(loss);
    for (std::size_t i = 0; i < s.config.losses.size(); ++i) out.losses.push_back(losses.terms[i]);
  }
  for (const Tensor<float>& t : s.pipeline->store().all())
    if (t.learned()) out.learned = crc32c(std::as_bytes(std::span(t.value.data(), t.value.size())), out.learned);
  const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(s.scene.frames_of(Split::test).front())];
  const RenderedFrame seen = render_frame(*s.pipeline, {info.camera, info.world_from_camera, s.plan.undistortion},
                                          s.limits, s.plan.class_of_logit);
  out.color = seen.rgb;
  for (const float depth : seen.depth_m) out.depth_m += static_cast<double>(depth) / std::ssize(seen.depth_m);
  return out;
}

const std::vector<std::string> kSmallGrid{"train.rays=48",
                                          "semantics.hidden_width=8",
                                          "passes.main.sampler.resolution=32",
                                          "passes.main.sampler.warmup_steps=16",
                                          "passes.main.sampler.max_samples=24",
                                          "passes.main.position.levels=4",
                                          "passes.main.position.log2_entries=10",
                                          "passes.main.field={type: tiny_mlp, hidden_width: 16, color_width: 16}"};
const std::vector<std::string> kSmallPaper{
    "train.rays=24", "semantics.hidden_width=8", "passes.coarse.sampler.samples=8", "passes.fine.sampler.samples=8",
    "passes.coarse.field={type: nerf_mlp, depth: 2, width: 16, skip_at: 1, view_width: 8}"};

std::vector<std::string> grid_with(const std::vector<std::string>& more) {
  std::vector<std::string> set = kSmallGrid;
  set.insert(set.end(), more.begin(), more.end());
  return set;
}

std::string two_pass(const std::string& rendering, const std::string& position, const std::string& sampler = "",
                     const std::string& more = "") {
  const std::string pass = "    position: {" + position +
                           "}\n    direction: {type: spherical_harmonics, degree: 2}\n"
                           "    field: {type: nerf_mlp, depth: 2, width: 16, skip_at: 1, view_width: 8}\n";
  return "semantics: {hidden_width: 8}\nrendering: {" + rendering +
         "}\npasses:\n  - sampler: {type: stratified, samples: 8" + sampler + "}\n" + pass +
         "  - sampler: {type: importance, samples: 8}\n" + pass + "train: {steps: 24, rays: 24}\n" + more;
}

const char* const kFrequency = "type: frequency, frequencies: 5";
const char* const kPhotographs = "with_depth: false, ";

std::vector<Case> cases() {
  const std::string losses =
      "losses: [{type: depth, weight: 0.3}, {type: distortion, weight: 0.2, from_step: 0}, {type: near_density, "
      "weight: "
      "0.1, from_step: 0}, {type: generalised_cross_entropy, weight: 0.3}]\n";
  return {
      {"room", "presets/room.yaml", "", kSmallGrid, true},
      {"room without depth", "presets/room.yaml", kPhotographs, kSmallGrid},
      {"room with learned cameras", "presets/room.yaml", "tracked: true, ",
       grid_with({"train.cameras={poses: learned, colors: learned, from_step: 0}"}), true},
      {"object", "presets/object.yaml", "", kSmallGrid, true},
      {"unbounded", "presets/unbounded.yaml", "", kSmallGrid},
      {"unbounded without depth", "presets/unbounded.yaml", kPhotographs, kSmallGrid},
      {"paper", "paper.yaml", "", kSmallPaper},
      {"paper without depth", "paper.yaml", kPhotographs, kSmallPaper},
      {"quickstart", "quickstart.yaml", "", kSmallGrid},
      {"relu with noise", two_pass("density_activation: relu, density_noise: 1, density_bias: 0.5", kFrequency), ""},
      {"softplus", two_pass("density_activation: softplus, far: background", kFrequency), ""},
      {"trunc_exp", two_pass("density_activation: trunc_exp, far: closed", kFrequency), ""},
      {"every loss", two_pass("density_activation: softplus", kFrequency, "", losses), ""},
      {"line of sight and disparity",
       two_pass("density_activation: softplus", kFrequency, ", spacing: disparity",
                "losses: [{type: depth, kind: line_of_sight}, {type: distortion, space: disparity, from_step: 0}]\n"),
       ""},
      {"one_blob", two_pass("density_activation: softplus", "type: one_blob"), ""},
      {"identity", two_pass("density_activation: softplus", "type: identity"), ""},
  };
}

TEST(Units, APowerOfTwoChangesNoBit) {
  for (const Case& c : cases()) {
    SCOPED_TRACE(c.name);
    const Outcome want = train_in_unit(c, 1);
    for (const double scale : {0x1p-13, 0x1p10, 0x1p20}) {
      SCOPED_TRACE(scale);
      const Outcome got = train_in_unit(c, scale);
      EXPECT_EQ(got.unit_m, want.unit_m * scale);
      EXPECT_EQ(got.losses, want.losses);
      EXPECT_EQ(got.learned, want.learned);
      EXPECT_EQ(got.color, want.color);
      EXPECT_NEAR(got.depth_m, want.depth_m * scale, 1e-12 * want.depth_m * scale);
    }
  }
}

TEST(Units, AnyOtherChangesNoMoreThanRounding) {
  for (const Case& c : cases()) {
    SCOPED_TRACE(c.name);
    const Outcome want = train_in_unit(c, 1);
    for (const double scale : {1e-4, 1e3, 1e6}) {
      SCOPED_TRACE(scale);
      const Outcome got = train_in_unit(c, scale);
      EXPECT_NEAR(got.unit_m, want.unit_m * scale, 1e-6 * want.unit_m * scale);
      ASSERT_EQ(got.losses.size(), want.losses.size());
      for (std::size_t i = 0; i < want.losses.size(); ++i)  // rounding grows from step to step, to 2.3 % at most
        EXPECT_NEAR(got.losses[i], want.losses[i], 0.05 * std::abs(want.losses[i])) << i;
      EXPECT_NEAR(got.depth_m, want.depth_m * scale, 0.02 * want.depth_m * scale);
      double off = 0;
      for (std::size_t i = 0; i < want.color.size(); ++i)
        off += std::abs(static_cast<double>(got.color[i] - want.color[i])) / static_cast<double>(want.color.size());
      EXPECT_LT(off, 0.005);
    }
  }
}

}  // namespace
}  // namespace semfield
