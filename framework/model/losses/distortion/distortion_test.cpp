// The distortion loss against the double sum of its paper, and what it wants of a ray.
#include "model/losses/distortion/distortion.h"

#include <gtest/gtest.h>

#include "testkit/loss_rays.h"

namespace semfield {
namespace {

using testkit::LossRays;

// sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d_i as it stands [Barron22, Eq. 15], O(n^2).
double as_written(LossRays<double>& rays, DistortionSpace space) {
  double sum = 0;
  for (std::int64_t r = 0; r < rays.rays(); ++r) {
    const auto at = static_cast<std::size_t>(r);
    const double near_m = rays.near_far[2 * at], far_m = rays.near_far[2 * at + 1];
    const auto place = [&](double t) {
      t = std::min(std::max(t, near_m), far_m);
      if (space == DistortionSpace::linear) return (t - near_m) / (far_m - near_m);
      return (1 / t - 1 / near_m) / (1 / far_m - 1 / near_m);
    };
    for (auto i = static_cast<std::size_t>(rays.first[at]); i < static_cast<std::size_t>(rays.first[at + 1]); ++i) {
      for (auto j = static_cast<std::size_t>(rays.first[at]); j < static_cast<std::size_t>(rays.first[at + 1]); ++j)
        sum += rays.weight[i] * rays.weight[j] * std::abs(place(rays.t[i]) - place(rays.t[j]));
      const double length = place(rays.t[i] + rays.delta[i] / 2) - place(rays.t[i] - rays.delta[i] / 2);
      sum += rays.weight[i] * rays.weight[i] * length / 3;
    }
  }
  return sum;
}

TEST(DistortionLoss, IsTheDoubleSumOfThePaper) {
  for (const DistortionSpace space : {DistortionSpace::linear, DistortionSpace::disparity}) {
    LossRays<double> rays(testkit::awkward_ray_lengths());
    DistortionLoss loss;
    loss.params.space = space;
    const double want = as_written(rays, space);
    EXPECT_NEAR(rays.add(loss, 1), want, 1e-12 * want);
  }
}

TEST(DistortionLoss, IsLeastWhereLightComesFromOnePlace) {
  const DistortionLoss loss;
  LossRays<double> spread({5}), close({5}), one({5});
  for (LossRays<double>* rays : {&spread, &close, &one}) {
    rays->near_far = {0, 5};
    rays->t = {0.5, 1.5, 2.5, 3.5, 4.5};
    rays->delta.assign(5, 1);
  }
  spread.weight = {0.5, 0, 0, 0, 0.5};
  close.weight = {0, 0.5, 0.5, 0, 0};
  one.weight = {0, 1, 0, 0, 0};
  EXPECT_DOUBLE_EQ(spread.add(loss, 1), 0.5 * 0.8 + 0.5 * 0.2 / 3);
  EXPECT_DOUBLE_EQ(close.add(loss, 1), 0.5 * 0.2 + 0.5 * 0.2 / 3);
  EXPECT_NEAR(one.add(loss, 1), 0.2 / 3, 1e-15);
  // A little more light at the first of the far apart samples costs what lies between it and the other one.
  EXPECT_DOUBLE_EQ(spread.d_weight[0], 2 * (0.5 * 0.8 + 0.5 * 0.2 / 3));
}

}  // namespace
}  // namespace semfield
