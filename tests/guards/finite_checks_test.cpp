// I07: every finite check of this build, on every instruction set, sees a NaN and an infinity at every position.
#include <gtest/gtest.h>

#include "compute/math_functions.h"
#include "model/compositor.h"
#include "model/losses/semantic_cross_entropy.h"
#include "model/optim/adam.h"
#include "model/stages.h"

namespace semfield {
namespace {

template <class Real>
class FiniteChecks : public ::testing::Test {};
using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(FiniteChecks, Reals);

template <class Real>
std::vector<Real> bad_values() {
  const Real inf = std::numeric_limits<Real>::infinity();
  return {std::numeric_limits<Real>::quiet_NaN(), -std::numeric_limits<Real>::quiet_NaN(), inf, -inf};
}

constexpr std::int32_t kMost = 70;

TYPED_TEST(FiniteChecks, SeeEveryPosition) {
  using Real = TypeParam;
  for (std::int32_t n = 1; n <= kMost; ++n) {
    std::vector<Real> x(static_cast<std::size_t>(n), Real(0.25)), half = x;
    Samples<Real> samples;
    std::vector<std::int32_t> ray(static_cast<std::size_t>(n), 0), first{0, n};
    samples.t = samples.delta = {half.data(), n, 1};
    samples.ray_of_sample = {ray.data(), n, 1};
    samples.first = {first.data(), 2, 1};
    samples.count = n;
    const GuardPlace<Real> place{"main", 0, &samples};
    const View<const Real> column(x.data(), n, 1), row(x.data(), 1, n), sound(half.data(), n, 1);
    const auto all_pass = [&] {
      return all_finite(x.data(), n) && first_non_finite<Real>(column) == -1 &&
             first_unsound<Real>(column, column, column, column, true).element == -1;
    };
    EXPECT_TRUE(all_pass());
    EXPECT_NO_THROW(guard_values<Real>(place, Guarded::feature, column));
    EXPECT_NO_THROW(check_density<Real>(samples, column));
    for (std::int32_t at = 0; at < n; ++at) {
      for (const Real bad : bad_values<Real>()) {
        x[at] = bad;
        EXPECT_FALSE(all_finite(x.data(), n));
        EXPECT_EQ(first_non_finite<Real>(column), at);
        for (const bool touched : {false, true}) {
          EXPECT_EQ(first_unsound<Real>(column, sound, sound, sound, touched).element, at);
          EXPECT_EQ(first_unsound<Real>(sound, column, sound, sound, touched).element, at);
          EXPECT_EQ(first_unsound<Real>(sound, sound, column, sound, touched).element, at);
          EXPECT_EQ(first_unsound<Real>(sound, sound, sound, column, touched).element, at);
        }
        EXPECT_THROW(guard_values<Real>(place, Guarded::feature, column), RayFault);
        EXPECT_THROW(guard_values<Real>(place, Guarded::logits, row), RayFault);
        EXPECT_THROW(check_density<Real>(samples, column), RayFault);
        std::vector<Real> out(static_cast<std::size_t>(n));
        EXPECT_THROW(softmax<Real>(row, View<Real>(out.data(), 1, n)), Error);
        samples.t = {x.data(), n, 1};
        EXPECT_THROW(guard_samples<Real>(place, {}), RayFault);
        samples.t = {half.data(), n, 1};
        samples.delta = {x.data(), n, 1};
        EXPECT_THROW(guard_samples<Real>(place, {}), RayFault);
        samples.delta = {half.data(), n, 1};
        x[at] = Real(0.25);
      }
    }
  }
}

TYPED_TEST(FiniteChecks, LetTheLargestAndTheSmallestNumbersPass) {
  using Real = TypeParam;
  const std::vector<Real> x{std::numeric_limits<Real>::max(), -std::numeric_limits<Real>::max(),
                            std::numeric_limits<Real>::denorm_min(), Real(-0.0)};
  EXPECT_TRUE(all_finite(x.data(), 4));
  EXPECT_EQ(first_non_finite<Real>(View<const Real>(x.data(), 4, 1)), -1);
}

}  // namespace
}  // namespace semfield
