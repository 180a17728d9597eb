// The same bits for any number of threads and any grouping of rays, on real training runs.

#include <cmath>
#include <numeric>

#include "compute/parallel.h"
#include "config/config_words.h"
#include "core/checksum.h"
#include "eval/evaluator.h"
#include "tests/session/oracle.h"
#include "tests/session/step_configs.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using namespace testing_train;

class SameBits : public ::testing::TestWithParam<StepCase> {};

// Past the warm-up of the occupancy grid in fp32, a few steps in bf16.
TEST_P(SameBits, ForAnyNumberOfThreads) {
  const std::string yaml = GetParam().config(GetParam().more);
  const std::uint32_t one = train_fingerprint(yaml, 1, 36);
  EXPECT_EQ(one, train_fingerprint(yaml, 3, 36));
  const std::string bf16 = yaml + "runtime: {device: cpu, precision: bf16}\n";
  const std::uint32_t rounded = train_fingerprint(bf16, 1, 5);
  EXPECT_EQ(rounded, train_fingerprint(bf16, 3, 5));
  EXPECT_NE(rounded, train_fingerprint(yaml, 2, 5));
}
INSTANTIATE_TEST_SUITE_P(All, SameBits, ::testing::ValuesIn(kStepCases), name_of_step);

// Past the warm-up of the occupancy grid.
TEST(Determinism, Bf16BehindAnOccupancyGridHasTheSameBitsForAnyNumberOfThreads) {
  const std::string yaml = hash_config("runtime: {device: cpu, precision: bf16}\n");
  EXPECT_EQ(train_fingerprint(yaml, 1, 36), train_fingerprint(yaml, 3, 36));
}

TEST(Determinism, AnotherSeedGivesAnotherRun) {
  EXPECT_NE(train_fingerprint(two_pass_config(), 2, 3),
            train_fingerprint(two_pass_config("runtime: {seed: 2}\n"), 2, 3));
}

TEST(Determinism, AKeptSceneIsLoadedOnceAndTrainsTheSameBits) {
  KeptScene kept;
  const auto open = [&](const std::string& more, KeptScene* from) {
    Diagnostics diagnostics;
    RunConfig config = read_run_config(parse_config_text(hash_config(more), "test.yaml"), all_plugins(), diagnostics);
    return open_session(std::move(config), all_plugins(), {.kept = from}, diagnostics);
  };
  const auto bits = [&](KeptScene* from) {
    Session s = open("", from);
    Trainer trainer(s);
    while (trainer.step() < 3) trainer.advance(3 - trainer.step());
    trainer.collect();
    return fingerprint(s.pipeline->store());
  };
  const std::uint32_t own = bits(nullptr);
  EXPECT_EQ(bits(&kept), own);
  kept.scene.info.name = "kept";
  EXPECT_EQ(open("report: {eval_stride: 2}\nruntime: {seed: 3}\n", &kept).scene.info.name, "kept");
  EXPECT_EQ(bits(&kept), own);
  EXPECT_NE(open("losses: [{type: depth, weight: 0.1}]\n", &kept).scene.info.name, "kept") << "depth is kept for it";
}

TEST(Determinism, NoMemoryIsRequestedInSteadyState) {
  Session s = open_text(two_pass_config());
  Trainer trainer(s);
  for (int i = 0; i < 3; ++i) trainer.advance();
  const std::int64_t growths = s.pipeline->lanes().workspace_growths();
  for (int i = 0; i < 10; ++i) trainer.advance();
  EXPECT_EQ(growths, s.pipeline->lanes().workspace_growths());
}

// Class probabilities of rays and of whole frames: softmax of composited logits, the same bits in any grouping of rays.

// Rays through pixels of a session's first frame, row by row.
struct FrameRays {
  FrameRays(const Session& s, std::int64_t rays) : count(rays) {
    const auto size = static_cast<std::size_t>(rays);
    origin.resize(3 * size);
    direction.resize(3 * size);
    near_far.resize(2 * size);
    const FrameInfo& info = s.scene.info.frames.front();
    for (std::size_t k = 0; k < size; ++k) {
      const auto i = static_cast<std::int32_t>(k);
      cast_ray({info.camera, info.world_from_camera, true}, s.limits, i % info.camera.width_px,
               i / info.camera.width_px, &origin[3 * k], &direction[3 * k], &near_far[2 * k]);
    }
  }
  template <class Real>
  RenderJob<Real> job(std::vector<Real>& probability, std::size_t logits) const {
    probability.assign(static_cast<std::size_t>(count) * logits, Real(-1));
    return RenderJob<Real>{.origin = {origin.data(), count, 3},
                           .direction = {direction.data(), count, 3},
                           .near_far = {near_far.data(), count, 2},
                           .probability = {probability.data(), count, static_cast<std::int32_t>(logits)}};
  }
  std::int64_t count;
  std::vector<double> origin, direction, near_far;
};

TEST(Probability, OfAFrameSumsToOneAndItsLargestIsTheLabelsConfidence) {
  const std::string absent = "{type: analytic_room, frames: 4, absent_class: 1, labels: {frames: 1}}";
  for (const std::string& yaml : {hash_config(), two_pass_config(), with_scene(hash_config(), absent)}) {
    Trainer training(run_config_of(parse_config_text(yaml, "test.yaml"), all_plugins()), all_plugins());
    training.train(40);
    const Session& s = training.session();
    const FrameInfo& info = s.scene.info.frames.front();
    FrameOptions asked{.stride = 3, .probability = true};
    const RenderedFrame frame = training.render(info.camera, info.world_from_camera, asked);
    const auto classes = static_cast<std::size_t>(s.classes());
    ASSERT_EQ(frame.probability.size(), classes * frame.label.size());
    std::vector<double> mass(classes, 0);
    for (std::size_t i = 0; i < frame.label.size(); ++i) {
      const float* const row = &frame.probability[classes * i];
      ASSERT_NEAR(std::accumulate(row, row + classes, 0.0), 1, 1e-5) << "pixel " << i;
      const float* const best = std::max_element(row, row + classes);
      ASSERT_EQ(best - row, frame.label[i]) << "pixel " << i;
      ASSERT_EQ(*best, frame.confidence[i]) << "pixel " << i;
      for (std::size_t c = 0; c < classes; ++c) mass[c] += static_cast<double>(row[c]);
    }
    const ClassOfLogit& has = s.plan.class_of_logit;
    for (std::size_t c = 0; c < classes; ++c)
      EXPECT_EQ(mass[c] > 0, std::find(has.begin(), has.end(), static_cast<int>(c)) != has.end()) << "class " << c;
    EXPECT_EQ(has.size() < classes, yaml.find("absent_class") != std::string::npos);
  }
}

TEST(Determinism, RenderingIsTheSameForAnyGroupingOfRays) {
  TestRun run(hash_config());
  run.to(60);
  const Session& s = run.session;
  const FrameRays rays(s, 500);
  const auto render = [&](std::int64_t chunk) {
    std::vector<float> probability, others(6 * 500, 0.0F);
    RenderJob<float> job = rays.job(probability, s.plan.class_of_logit.size());
    job.color = {others.data(), 500, 3};
    job.depth = {others.data() + 3 * 500, 500, 1};
    job.entropy = {others.data() + 4 * 500, 500, 1};
    job.confidence = {others.data() + 5 * 500, 500, 1};
    for (std::int64_t begin = 0; begin < 500; begin += chunk)
      s.pipeline->executor().render(job.rows(begin, std::min<std::int64_t>(chunk, 500 - begin)));
    EXPECT_EQ(std::count(probability.begin(), probability.end(), -1.0F), 0);
    probability.insert(probability.end(), others.begin(), others.end());
    return probability;
  };
  const std::vector<float> whole = render(500);
  EXPECT_EQ(whole, render(7));
  EXPECT_EQ(whole, render(129));
  set_thread_count(1);
  EXPECT_EQ(whole, render(64));
  set_thread_count(0);
}

// The float pipeline against the same parameters in double, and those against the sum of exponentials of its logits.
TEST(Probability, AgreesWithTheOracleInDouble) {
  TestRun run(two_pass_config());
  run.to(600);
  const Session& s = run.session;
  const auto oracle = assemble(make_parts<double>(s.config, all_plugins(), s.plan, s.extent), {}, true);
  for (Tensor<double>& t : oracle->store().all()) {
    const Tensor<float>* const from = s.pipeline->store().find(t.name);
    ASSERT_NE(from, nullptr) << t.name;
    std::copy_n(from->value.data(), t.value.size(), t.value.data());
  }
  oracle->derive(600);
  const FrameRays rays(s, 300);
  const std::size_t logits = s.plan.class_of_logit.size();
  std::vector<float> found;
  std::vector<double> wanted, entropy(300);
  s.pipeline->executor().render(rays.job(found, logits));
  RenderJob<double> job = rays.job(wanted, logits);
  job.entropy = {entropy.data(), rays.count, 1};
  oracle->executor().render(job);
  double widest = 0, of_rows = 0;
  for (std::size_t i = 0; i < found.size(); ++i) {
    ASSERT_NEAR(found[i], wanted[i], 1e-4) << "ray " << i / logits << ", logit " << i % logits;
    widest = std::max(widest, wanted[i]);
  }
  EXPECT_GT(widest, 0.5) << "rows that are nearly even would show little";
  for (std::size_t r = 0; r < entropy.size(); ++r) {
    of_rows = 0;
    for (std::size_t k = 0; k < logits; ++k) of_rows -= wanted[logits * r + k] * std::log(wanted[logits * r + k]);
    ASSERT_NEAR(of_rows, entropy[r], 1e-12) << "ray " << r;
  }
}

// A scene in another unit trains, renders and scores alike: every length is measured in the scene's own extent.

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

Session open_in_unit(const Case& c, double scale) {
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
  return open_session(run_config_of(tree.with("scene", *scene.find("scene")), all_plugins()), all_plugins(), {},
                      diagnostics);
}

Outcome train_in_unit(const Case& c, double scale) {
  Session s = open_in_unit(c, scale);
  constexpr std::int64_t kSteps = 24;
  s.config.train.steps = kSteps;
  Trainer trainer(s);
  Outcome out;
  out.unit_m = s.config.rendering.unit_m;
  while (trainer.step() < kSteps) {
    const StepLosses losses = trainer.advance().back();
    for (const double loss : {losses.total, losses.color, losses.semantic}) out.losses.push_back(loss);
    for (std::size_t i = 0; i < s.config.losses.size(); ++i) out.losses.push_back(losses.terms[i]);
  }
  for (const Tensor<float>& t : s.pipeline->store().all())
    if (t.learned()) out.learned = crc32c(std::as_bytes(std::span(t.value.data(), t.value.size())), out.learned);
  const RenderedFrame seen = render_frame_of(s, s.scene.frames_of(Split::test).front());
  out.color = seen.rgb;
  for (const float depth : seen.depth_m) out.depth_m += static_cast<double>(depth) / std::ssize(seen.depth_m);
  return out;
}

const std::string kOfMain = "passes.main.";
const std::vector<std::string> kSmallGrid{"train.rays=48",
                                          "semantics.hidden_width=8",
                                          kOfMain + "sampler.resolution=32",
                                          kOfMain + "sampler.warmup_steps=16",
                                          kOfMain + "sampler.max_samples=24",
                                          kOfMain + "position.levels=4",
                                          kOfMain + "position.log2_entries=10",
                                          kOfMain + "field={type: tiny_mlp, hidden_width: 16, color_width: 16}"};
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
      "weight: 0.1, from_step: 0}, {type: generalised_cross_entropy, weight: 0.3}]\n";
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

}  // namespace
}  // namespace semfield
