// Compute threads flush subnormals, on every thread and in every call; the caller's own mode comes back.
#include "compute/float_mode.h"

#include <gtest/gtest.h>

#include <atomic>
#include <cfenv>
#include <limits>
#include <stdexcept>

#include "compute/parallel.h"

namespace semfield {
namespace {

#if defined(__SSE2__) || defined(__aarch64__)
constexpr bool kHasMode = true;
#else
constexpr bool kHasMode = false;
#endif

// Through volatile, so that nothing is computed before the program runs.
bool flushes() {
  const volatile float small = 1e-20F, subnormal = std::numeric_limits<float>::denorm_min(), large = 1e30F;
  const volatile double tiny = 1e-160;
  const volatile float product = small * small, scaled = subnormal * large;
  const volatile double wide = tiny * tiny;
  return product == 0 && scaled == 0 && wide == 0;
}

bool rounds_to_nearest() {
  const volatile float one = 1, little = 1e-10F;
  const volatile float sum = one + little;
  return sum == 1;
}

class FloatMode : public testing::Test {
 protected:
  void SetUp() override {
    if (!kHasMode) GTEST_SKIP() << "this processor has no mode that flushes subnormals";
    ASSERT_FALSE(ComputeFloatMode::in_effect()) << "the test's own thread keeps subnormals";
  }
  void TearDown() override {
    EXPECT_FALSE(ComputeFloatMode::in_effect());
    EXPECT_FALSE(flushes());
    std::fesetround(FE_TONEAREST);
    set_thread_count(0);
  }
};

TEST_F(FloatMode, ScopesNestAndGiveTheCallersModeBack) {
  std::fesetround(FE_UPWARD);
  EXPECT_FALSE(rounds_to_nearest());
  {
    const ComputeFloatMode outer;
    EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest());
    {
      const ComputeFloatMode inner;
      EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes());
    }
    EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest());
  }
  EXPECT_EQ(std::fegetround(), FE_UPWARD);
  EXPECT_FALSE(rounds_to_nearest());
}

TEST_F(FloatMode, EveryTaskFlushesForAnyThreadCountAndCaller) {
  for (const int rounding : {FE_TONEAREST, FE_UPWARD}) {
    for (const int threads : {1, 2, 16}) {
      for (const std::int64_t count : {1, 64}) {
        set_thread_count(threads);
        std::fesetround(rounding);
        std::atomic<int> tasks{0}, other_modes{0};
        const auto look = [&] {
          ++tasks;
          other_modes += ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest() ? 0 : 1;
        };
        parallel_for(count, [&](std::int64_t) {
          look();
          parallel_for(3, [&](std::int64_t) { look(); });
          look();
        });
        EXPECT_EQ(tasks, 5 * count);
        EXPECT_EQ(other_modes, 0) << threads << " threads, " << count << " indices";
        EXPECT_FALSE(ComputeFloatMode::in_effect());
        EXPECT_EQ(std::fegetround(), rounding);
      }
    }
  }
}

TEST_F(FloatMode, TheCallersModeComesBackAfterAnException) {
  for (const int threads : {1, 4}) {
    set_thread_count(threads);
    std::fesetround(FE_DOWNWARD);
    EXPECT_THROW(parallel_for(8, [](std::int64_t) { throw std::runtime_error("body"); }), std::runtime_error);
    EXPECT_EQ(std::fegetround(), FE_DOWNWARD);
    EXPECT_FALSE(ComputeFloatMode::in_effect());
  }
}

}  // namespace
}  // namespace semfield
