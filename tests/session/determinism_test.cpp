// The same bits for any number of threads and any grouping of rays, on real training runs.
#include <gtest/gtest.h>

#include <algorithm>
#include <cfenv>
#include <cmath>
#include <limits>

#include "compute/float_mode.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "execution/lane_executor.h"
#include "session/trainer.h"
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
  GTEST_SKIP() << "this processor has no mode that flushes subnormals";
#endif
  std::uint32_t first = 0;
  for (const int rounding : {FE_TONEAREST, FE_UPWARD}) {
    for (const int threads : {1, 2, 16}) {
      Registry registry = make_registry();
      Session s = open_text(two_pass_config(), registry);
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

TEST(Determinism, RenderingIsTheSameForAnyGroupingOfRays) {
  Registry registry = make_registry();
  Session s = open_text(hash_config(), registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  while (trainer.step() < 60) trainer.advance();
  const FrameInfo& info = s.scene.info.frames.front();
  const std::int64_t rays = 500;
  std::vector<double> origin(3 * rays), direction(3 * rays), near_far(2 * rays);
  for (std::int64_t i = 0; i < rays; ++i) {
    const auto k = static_cast<std::size_t>(i);
    cast_ray({info.camera, info.world_from_camera, true}, s.limits, static_cast<std::int32_t>(i % 48),
             static_cast<std::int32_t>(i / 48), &origin[3 * k], &direction[3 * k], &near_far[2 * k]);
  }
  const auto render = [&](std::int64_t chunk) {
    std::vector<float> out(3 * rays + 3 * rays, 0.0F);
    for (std::int64_t begin = 0; begin < rays; begin += chunk) {
      const std::int64_t count = std::min(chunk, rays - begin);
      RenderJob<float> job;
      job.origin = {origin.data() + 3 * begin, count, 3};
      job.direction = {direction.data() + 3 * begin, count, 3};
      job.near_far = {near_far.data() + 2 * begin, count, 2};
      job.color = {out.data() + 3 * begin, count, 3};
      job.depth = {out.data() + 3 * rays + begin, count, 1};
      job.entropy = {out.data() + 4 * rays + begin, count, 1};
      job.confidence = {out.data() + 5 * rays + begin, count, 1};
      s.pipeline->render(job);
    }
    return out;
  };
  const std::vector<float> whole = render(rays);
  EXPECT_EQ(whole, render(7));
  EXPECT_EQ(whole, render(129));
  set_thread_count(1);
  EXPECT_EQ(whole, render(64));
  set_thread_count(0);
}

TEST(Determinism, NoMemoryIsRequestedInSteadyState) {
  Registry registry = make_registry();
  Session s = open_text(two_pass_config(), registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  for (int i = 0; i < 3; ++i) trainer.advance();
  const std::int64_t growths = s.pipeline->lanes().workspace_growths();
  for (int i = 0; i < 10; ++i) trainer.advance();
  EXPECT_EQ(growths, s.pipeline->lanes().workspace_growths());
  EXPECT_LE(s.pipeline->lanes().workspace_bytes(), s.pipeline->predicted_workspace_bytes(s.config.train.rays));
}

}  // namespace
}  // namespace semfield
