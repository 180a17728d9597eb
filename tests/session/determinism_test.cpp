// The same bits for any number of threads and any grouping of rays, on real training runs.
#include <cfenv>
#include <numeric>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "eval/evaluator.h"
#include "execution/lane_executor.h"
#include "session/trainer.h"
#include "session/training.h"
#include "tests/session/oracle.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

TEST(Determinism, HashRunOf200StepsIsTheSameFor1And2And4Threads) {
  const std::uint32_t one = train_fingerprint(hash_config(), 1, 200);
  EXPECT_EQ(one, train_fingerprint(hash_config(), 2, 200));
  EXPECT_EQ(one, train_fingerprint(hash_config(), 4, 200));
}

TEST(Determinism, TwoPassRunIsTheSameFor1And3Threads) {
  const std::uint32_t one = train_fingerprint(two_pass_config(), 1, 25);
  EXPECT_EQ(one, train_fingerprint(two_pass_config(), 3, 25));
}

TEST(Determinism, Bf16RunIsTheSameFor1And2ThreadsAndNotThatOfFp32) {
  const std::string bf16 = "runtime: {precision: bf16}\n";
  const std::uint32_t one = train_fingerprint(hash_config(bf16), 1, 40);
  EXPECT_EQ(one, train_fingerprint(hash_config(bf16), 2, 40));
  EXPECT_NE(one, train_fingerprint(hash_config(), 2, 40));
  EXPECT_EQ(train_fingerprint(two_pass_config(bf16), 1, 5), train_fingerprint(two_pass_config(bf16), 3, 5));
}

// Every third value of what a step reads and writes is subnormal.
void make_subnormal(ParamStore<float>& store) {
  for (Tensor<float>& t : store.all()) {
    if (t.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); i += 3) buffer->data()[i] = 1e-39F;
    }
  }
}

int subnormal_count(const ParamStore<float>& store) {
  int found = 0;
  for (const Tensor<float>& t : store.all()) {
    if (t.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.grad, &t.moment1, &t.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); ++i)
        found += std::fpclassify(buffer->data()[i]) == FP_SUBNORMAL ? 1 : 0;
    }
  }
  return found;
}

TEST(Determinism, AStepLeavesNoSubnormalNumberForAnyThreadCountAndCallersMode) {
#if !defined(__SSE2__) && !defined(__aarch64__)
  GTEST_SKIP() << "this CPU has no mode that flushes subnormals";
#endif
  std::uint32_t first = 0;
  for (const int rounding : {FE_TONEAREST, FE_UPWARD}) {
    for (const int threads : {1, 2, 16}) {
      Session s = open_text(two_pass_config());
      make_subnormal(s.pipeline->store());
      const auto rays = s.make_ray_source();
      Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule);
      set_thread_count(threads);
      std::fesetround(rounding);
      for (int i = 0; i < 2; ++i) trainer.advance();
      EXPECT_EQ(std::fegetround(), rounding);
      EXPECT_FALSE(ComputeFloatMode::in_effect());
      // A step that throws gives the caller's mode back too.
      const std::uint32_t made = fingerprint(s.pipeline->store());
      EXPECT_EQ(subnormal_count(s.pipeline->store()), 0) << threads << " threads";
      s.pipeline->store().all().front().value.data()[0] = std::numeric_limits<float>::quiet_NaN();
      EXPECT_THROW(trainer.advance(), Error);
      EXPECT_EQ(std::fegetround(), rounding);
      EXPECT_FALSE(ComputeFloatMode::in_effect());
      std::fesetround(FE_TONEAREST);
      set_thread_count(0);
      if (first == 0) first = made;
      EXPECT_EQ(made, first) << threads << " threads";
    }
  }
}

TEST(Determinism, AnotherSeedGivesAnotherRun) {
  EXPECT_NE(train_fingerprint(two_pass_config(), 2, 3),
            train_fingerprint(two_pass_config("runtime: {seed: 2}\n"), 2, 3));
}

TEST(Determinism, NoMemoryIsRequestedInSteadyState) {
  Session s = open_text(two_pass_config());
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  for (int i = 0; i < 3; ++i) trainer.advance();
  const std::int64_t growths = s.pipeline->lanes().workspace_growths();
  for (int i = 0; i < 10; ++i) trainer.advance();
  EXPECT_EQ(growths, s.pipeline->lanes().workspace_growths());
  EXPECT_LE(s.pipeline->lanes().workspace_bytes(), s.pipeline->predicted_workspace_bytes(s.config.train.rays));
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
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config(),
                                  with_scene(hash_config(),
                                             "{type: analytic_room, frames: 4, absent_class: 1, labels: "
                                             "{frames: 1}}")}) {
    Training training(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry);
    training.train(40);
    const Session& s = training.session();
    const FrameInfo& info = s.scene.info.frames.front();
    FrameOptions asked{.stride = 3, .probability = true};
    const RenderedFrame plain = training.render(info.camera, info.world_from_camera, {3, nullptr});
    const RenderedFrame frame = training.render(info.camera, info.world_from_camera, asked);
    EXPECT_TRUE(plain.probability.empty());
    EXPECT_EQ(plain.rgb, frame.rgb);
    EXPECT_EQ(plain.label, frame.label);
    EXPECT_EQ(plain.entropy, frame.entropy);
    EXPECT_EQ(plain.confidence, frame.confidence);
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
  Session s = open_text(hash_config());
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  while (trainer.step() < 60) trainer.advance();
  const FrameRays rays(s, 500);
  const auto render = [&](std::int64_t chunk) {
    std::vector<float> probability, others(6 * 500, 0.0F);
    RenderJob<float> job = rays.job(probability, s.plan.class_of_logit.size());
    job.color = {others.data(), 500, 3};
    job.depth = {others.data() + 3 * 500, 500, 1};
    job.entropy = {others.data() + 4 * 500, 500, 1};
    job.confidence = {others.data() + 5 * 500, 500, 1};
    for (std::int64_t begin = 0; begin < 500; begin += chunk)
      s.pipeline->render(job.rows(begin, std::min<std::int64_t>(chunk, 500 - begin)));
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
  Registry registry = make_registry();
  Session s = open_text(two_pass_config(), registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  while (trainer.step() < 600) trainer.advance();
  const auto oracle = assemble<double>(s.config, registry, s.plan, s.extent, {}, true);
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
  s.pipeline->render(rays.job(found, logits));
  RenderJob<double> job = rays.job(wanted, logits);
  job.entropy = {entropy.data(), rays.count, 1};
  oracle->render(job);
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

}  // namespace
}  // namespace semfield
