// Batches without a label leave the head bitwise alone; dead densities and thin matter between long steps are reported.
#include <cstdio>
#include <fstream>

#include "eval/final_eval.h"
#include "model/density_activation.h"
#include "run/run_loop.h"
#include "tests/guards/poison.h"
#include "tests/session/train_testing.h"

namespace semfield {

using namespace testing_train;

using namespace testing_guards;

bool is_head(const std::string& name) { return name.find("/semantic/") != std::string::npos; }

class VoidBatches : public ::testing::TestWithParam<const char*> {};

TEST_P(VoidBatches, LeaveTheHeadAlone) {
  const std::string normalisation = GetParam();
  Registry registry = make_registry();
  std::string yaml = two_pass_config();
  yaml.replace(yaml.find("weight: 0.3"), 11, "weight: 0.3, normalisation: " + normalisation);
  Subject subject(yaml, registry, 5);  // with labels: the head has moments
  const Snapshot before(subject);
  bool head_has_moments = false;
  for (const auto& [name, bits] : before.bits) {
    if (!is_head(name) || name.back() != 'm') continue;
    for (const std::uint32_t b : bits) head_has_moments = head_has_moments || b != 0;
  }
  ASSERT_TRUE(head_has_moments);

  // The same scene, every pixel void.
  std::vector<TrainFrame> frames;
  std::vector<TrainingLabels::Frame> labels(subject.session.scene.frames.size());
  for (const int f : subject.session.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    const FrameInfo& info = subject.session.scene.info.frames[i];
    const auto pixels =
        static_cast<std::size_t>(info.camera.width_px) * static_cast<std::size_t>(info.camera.height_px);
    labels[i].hard = LabelMap(std::vector<std::int16_t>(pixels, kVoid));
    frames.push_back({{info.camera, info.world_from_camera, false}, &subject.session.scene.frames[i], &labels[i], ""});
  }
  RaySourceOptions options{.train = {.rays = 64}, .tile_rays = subject.session.pipeline->tile_rays()};
  const RaySource source(std::move(frames), {0, 1, 2, 3, 4}, subject.session.limits, options);

  BatchBuffers batch;
  source.fill(5, batch);
  subject.store().zero_gradients();
  const StepLosses losses = subject.session.pipeline->gradients(5, batch.view(true));
  EXPECT_EQ(losses.semantic, 0);
  EXPECT_EQ(losses.labelled, 0);
  EXPECT_EQ(losses.total, losses.color);
  for (const Tensor<float>& t : subject.store().all()) {
    for (std::size_t i = 0; i < t.grad.size() && is_head(t.name); ++i) ASSERT_EQ(t.grad.data()[i], 0) << t.name;
  }
  subject.store().clear_gradients();

  Trainer trainer(*subject.session.pipeline, source, subject.session.config.adam, subject.session.config.schedule);
  for (int i = 0; i < 4; ++i) {
    const StepLosses step = trainer.advance();
    EXPECT_EQ(step.semantic, 0);
    EXPECT_TRUE(std::isfinite(step.total));
  }
  bool field_moved = false;
  for (const auto& [name, bits] : Snapshot(subject).bits) {
    if (is_head(name)) {
      EXPECT_EQ(bits, before.bits.at(name)) << name;
    } else {
      field_moved = field_moved || bits != before.bits.at(name);
    }
  }
  EXPECT_TRUE(field_moved);
}

INSTANTIATE_TEST_SUITE_P(Normalisations, VoidBatches, ::testing::Values("mean_labelled", "sum", "mean_rays"),
                         [](const auto& test) { return std::string(test.param); });

// A run in which most batches have no label writes numbers and nulls.
TEST(VoidBatchesRun, NoNanInTheLogs) {
  Registry registry = make_registry();
  const TempDir folder;
  std::string yaml = with_scene(two_pass_config("report: {log_every_steps: 1, eval_every_s: 0}\n"),
                                "{type: analytic_room, labels: {frames: 1}}");
  yaml.replace(yaml.find("steps: 50, rays: 64"), 19, "steps: 12, rays: 4");
  Diagnostics diagnostics;
  RunConfig config = read_run_config(parse_config_text(yaml, "test.yaml"), registry, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "");
  TrainRequest request{.out_dir = folder / "run"};
  run_training(std::move(config), registry, request, {});
  int rows = 0, without_label = 0;
  for (const char* name : {"/metrics.jsonl", "/final_eval.json"}) {
    std::ifstream file(request.out_dir + name);
    ASSERT_TRUE(file) << name;
    for (std::string line; std::getline(file, line); ++rows) {
      EXPECT_LACKS(line, "nan");
      without_label += line.find("\"loss_semantic\":0,") != std::string::npos ||
                               line.find("\"loss_semantic\": 0,") != std::string::npos ||
                               line.find("\"loss_semantic\":0.0,") != std::string::npos
                           ? 1
                           : 0;
    }
  }
  EXPECT_GE(rows, 13);
  EXPECT_GT(without_label, 0);
}

// A density that is 0 everywhere gets no gradient: the run says so within 200 steps, and no healthy run does.

std::string relu_yaml(int seed, const char* bias) {
  return "scene: {type: analytic_room, frames: 4, width_px: 16, height_px: 12, with_labels: false}\n"
         "rendering: {density_activation: relu, density_bias: " +
         std::string(bias) +
         "}\n"
         "passes:\n"
         "  - name: main\n"
         "    sampler: {type: stratified, samples: 6}\n"
         "    position: {type: frequency, frequencies: 2}\n"
         "    direction: {type: frequency, frequencies: 1}\n"
         "    field: {type: nerf_mlp, depth: 2, width: 8, skip_at: 0, view_width: 8}\n"
         "runtime: {seed: " +
         std::to_string(seed) +
         "}\n"
         "train: {steps: 200, rays: 16}\n";
}

struct Course {
  std::string message;
  std::int64_t stopped_at = -1;
  StepLosses last;
};

Course run(const std::string& yaml, Registry& registry, int steps) {
  Subject subject(yaml, registry, 0);
  Course course;
  for (int i = 0; i < steps && course.message.empty(); ++i) {
    const Snapshot before(subject);
    try {
      course.last = subject.trainer->advance();
    } catch (const Error& error) {
      course.message = error.what();
      course.stopped_at = subject.trainer->step();
      EXPECT_TRUE(Snapshot(subject) == before);
    }
  }
  return course;
}

// Seeds 0..99 with a start below zero: none has density anywhere.
TEST(DeadDensity, EverySeedIsStoppedWithin200Steps) {
  Registry registry = make_registry();
  int stopped = 0, recovered = 0;
  for (int seed = 0; seed < 100; ++seed) {
    const Course course = run(relu_yaml(seed, "-2"), registry, 200);
    if (course.message.empty()) {
      recovered += course.last.dense_passes == 1 ? 1 : 0;
      continue;
    }
    EXPECT_HAS(course.message, "pass 'main' had no density at any sample of the last 100 steps",
               "set rendering.density_activation to softplus");
    EXPECT_LT(course.stopped_at, 200);
    ++stopped;
  }
  std::printf("seeds stopped: %d, recovered: %d of 100\n", stopped, recovered);
  EXPECT_EQ(stopped + recovered, 100);
  EXPECT_GT(stopped, 90) << "the start was meant to be dead";
}

// Without a bias the seed decides. Whoever has no density is stopped; whoever has some is let alone.
TEST(DeadDensity, AnOpenStartIsStoppedOnlyWhenItDies) {
  Registry registry = make_registry();
  int stopped = 0;
  for (int seed = 0; seed < 100; ++seed) {
    const Course course = run(relu_yaml(seed, "0"), registry, 200);
    stopped += course.message.empty() ? 0 : 1;
    if (course.message.empty()) {
      EXPECT_EQ(course.last.dense_passes, 1U) << "seed " << seed;
    }
  }
  std::printf("seeds stopped without a bias: %d of 100\n", stopped);
  EXPECT_LT(stopped, 100);
}

TEST(DeadDensity, RemediesOfTheMessageRevive) {
  Registry registry = make_registry();
  std::string yaml = relu_yaml(3, "-2");
  yaml.replace(yaml.find("activation: relu"), 16, "activation: softplus");
  EXPECT_EQ(run(yaml, registry, 200).message, "");
  EXPECT_EQ(run(relu_yaml(3, "1"), registry, 200).message, "");
}

// Nothing to see and nothing seen: a black scene in front of a black background needs no density.
TEST(DeadDensity, HealthyRunsAreLetAlone) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    const Course course = run(yaml, registry, 220);
    EXPECT_EQ(course.message, "");
  }
  std::string unlabelled = hash_config();
  unlabelled = with_scene(unlabelled, "{type: analytic_room, labels: {frames: none}}");
  EXPECT_EQ(run(unlabelled, registry, 220).message, "");
}

TEST(DeadDensity, AnEmptySceneIsNoFault) {
  Registry registry = make_registry();
  Subject subject(relu_yaml(1, "-2"), registry, 0);
  FrameBuffer black{.width_px = 16, .height_px = 12};
  black.rgb.assign(576, 0);
  const StoredFrame stored(black);
  const FrameInfo& info = subject.session.scene.info.frames[0];
  RaySourceOptions options{.train = {.rays = 16}, .tile_rays = subject.session.pipeline->tile_rays()};
  const RaySource source({{{info.camera, info.world_from_camera, false}, &stored, nullptr, ""}}, {},
                         subject.session.limits, options);
  Trainer trainer(*subject.session.pipeline, source, subject.session.config.adam, subject.session.config.schedule);
  for (int i = 0; i < 220; ++i) ASSERT_EQ(trainer.advance().dense_passes, 0U);
}

// A10: opacity that came in one or two long steps is reported, with a remedy; short steps are not blamed.

struct SlabParams {
  double at_m = 1.2;
  double width_m = 0.02;
};
void describe(ParamVisitor& visit, SlabParams& p) {
  SEMFIELD_PARAM(visit, p, at_m, "x of the middle plane, metres", {-10, 10});
  SEMFIELD_PARAM(visit, p, width_m, "width, metres", {1e-6, 10});
}
void validate(const SlabParams&, Diagnostics&) {}

// Grey matter of optical depth 10 between two planes, nothing else.
template <class Real>
class Slab final : public Field<Real> {
 public:
  Slab(const SlabParams& p, const FieldBuild&, const KernelTables&) : p_(p) {}
  FieldTraits traits() const noexcept override { return {}; }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 64; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>& in, const FieldOut<Real>& out,
                  Saved) const override {
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const bool inside = std::abs(static_cast<double>(in.position(m, 0)) - p_.at_m) < 0.5 * p_.width_m;
      if (!out.sigma.empty()) out.sigma(m, 0) = static_cast<Real>(inside ? 10 / p_.width_m : -1);
      for (int c = 0; c < 3 && !out.rgb.empty(); ++c) out.rgb(m, c) = Real(0.5);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                   const FieldGrad<Real>&, Saved, View<Real>) const override {}

 private:
  SlabParams p_;
};

namespace {

SplitScore score_of(int samples, double width_m) {
  Registry registry = make_registry();
  registry.add_field<Slab, SlabParams>("slab", "matter between two planes");
  const std::string yaml =
      "scene: {type: analytic_room, with_labels: false}\n"
      "rendering: {density_activation: relu, scene_scale: 1}\n"
      "passes:\n"
      "  - name: main\n"
      "    sampler: {type: stratified, samples: " +
      std::to_string(samples) +
      "}\n"
      "    position: {type: identity}\n"
      "    direction: {type: spherical_harmonics, degree: 1}\n"
      "    field: {type: slab, width_m: " +
      std::to_string(width_m) + "}\n";
  const Session s = open_text(yaml, registry);
  return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit);
}

TEST(Resolution, AThinSlabBetweenLongStepsIsTold) {
  const SplitScore score = score_of(24, 0.02);
  ASSERT_GT(score.resolution.opaque_px, 0) << "some rays meet the slab by chance";
  EXPECT_GT(*score.resolution.share(), 0.95) << "all but rays that graze the slab";
  const std::string warning = score.resolution.warning();
  EXPECT_HAS(warning, " % of the pixels that meet something", "raise the sampler's samples");
}

TEST(Resolution, ShortStepsAndThickMatterAreNot) {
  EXPECT_EQ(score_of(1024, 0.02).resolution.under_resolved_px, 0);
  // Matter that fades in over many long steps is resolved as well as it is sharp.
  const SplitScore thick = score_of(48, 3);
  ASSERT_GT(thick.resolution.opaque_px, 100);
  EXPECT_EQ(thick.resolution.under_resolved_px, 0);
  EXPECT_EQ(thick.resolution.warning(), "");
}

TEST(Resolution, TheShareIsAmongTheFiguresAndInTheFile) {
  const SplitScore score = score_of(24, 0.02);
  bool found = false;
  for (const auto& [name, value] : score.values())
    found = found || (name == "under_resolved" && value == score.resolution.share());
  EXPECT_TRUE(found);
  const FinalEval read = parse_final_eval(final_eval_json(final_eval(score, {}, "test")), "test");
  EXPECT_EQ(read.resolution.opaque_px, score.resolution.opaque_px);
  EXPECT_EQ(read.resolution.under_resolved_px, score.resolution.under_resolved_px);
  EXPECT_EQ(OpacityCounts{}.share(), std::nullopt);
}

struct OneRay {
  std::vector<float> t, delta, weight;
  std::vector<std::int32_t> ray, first;
  Samples<float> samples;
  OneRay(std::vector<float> weights, float step) : weight(std::move(weights)) {
    const auto n = static_cast<std::int32_t>(weight.size());
    for (std::int32_t k = 0; k < n; ++k) t.push_back(2.0F + step * static_cast<float>(k));
    delta.assign(weight.size(), step);
    ray.assign(weight.size(), 0);
    first = {0, n};
    samples.t = {t.data(), n, 1};
    samples.delta = {delta.data(), n, 1};
    samples.ray_of_sample = {ray.data(), n, 1};
    samples.first = {first.data(), 2, 1};
    samples.count = n;
  }
  OpacityResolution look(FarMode far = FarMode::open, double footprint_per_m = 0.01) const {
    return opacity_resolution<float>(samples, View<const float>(weight.data(), samples.count, 1), far, 0,
                                     footprint_per_m);
  }
};

TEST(Resolution, TheRule) {
  using R = OpacityResolution;
  EXPECT_EQ(OneRay({0.2F, 0.2F}, 0.1F).look(), R::clear);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0, 0.5F, 0.45F}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0.2F, 0.3F, 0.3F, 0.2F}, 0.1F).look(), R::resolved);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.01F).look(), R::resolved) << "a step below the pixel's 0.02 m";
  EXPECT_EQ(OneRay({0, 0.1F, 0.9F}, 0.1F).look(FarMode::background), R::clear) << "the rest is no density";
  EXPECT_EQ(OneRay({}, 0.1F).look(), R::clear);
}

TEST(Resolution, BandsBeyondTheCoordinatesAreSaid) {
  std::string yaml = two_pass_config();
  yaml.replace(yaml.find("frequencies: 3"), 14, "frequencies: 30, arithmetic: float32");
  const Session s = open_text(yaml);
  ASSERT_EQ(s.chosen.size(), 1u);
  EXPECT_EQ(s.chosen[0].rfind("passes.coarse.position: warning: effective_bands is ", 0), 0u) << s.chosen[0];
}

}  // namespace
}  // namespace semfield
