// The near-density loss by hand: the optical depth of the first metres, however finely they are sampled.
#include "losses/near_density/near_density.h"

#include <gtest/gtest.h>

#include "testkit/loss_rays.h"

namespace semfield {
namespace {

using testkit::LossRays;

TEST(NearDensityLoss, IsTheOpticalDepthInFrontOfTheCamera) {
  NearDensityLoss loss;
  loss.params.distance_m = 0.5;
  LossRays<double> rays({4});
  rays.t = {0.1, 0.3, 0.5, 2};
  rays.delta = {0.2, 0.2, 0.2, INFINITY};
  rays.sigma = {3, 5, 7, 11};
  EXPECT_DOUBLE_EQ(rays.add(loss, 10), 0.2 * 3 + 0.2 * 5);
  EXPECT_EQ(rays.d_sigma, (std::vector<double>{2, 2, 0, 0}));
}

TEST(NearDensityLoss, ReachesThreeTenthsOfTheScenesUnit) {
  const NearDensityLoss loss;
  for (const double unit : {1e-4, 1.0, 1e6}) {
    LossRays<double> rays({3});
    rays.unit_m = unit;
    rays.t = {0.1 * unit, 0.29 * unit, 0.31 * unit};
    rays.delta = {0.2 * unit, 0.2 * unit, 0.2 * unit};
    rays.sigma = {3 / unit, 5 / unit, 7 / unit};
    EXPECT_NEAR(rays.add(loss, 1), 0.2 * 3 + 0.2 * 5, 1e-12) << unit;
  }
}

TEST(NearDensityLoss, DoesNotDependOnHowManySamplesThereAre) {
  NearDensityLoss loss;
  loss.params.distance_m = 1;
  for (const int samples : {4, 64}) {
    LossRays<double> rays({samples});
    for (int k = 0; k < samples; ++k) {
      rays.t[k] = (k + 0.5) / samples;
      rays.delta[k] = 1.0 / samples;
      rays.sigma[k] = 2;
    }
    EXPECT_NEAR(rays.add(loss, 1), 2, 1e-12) << samples;
  }
}

}  // namespace
}  // namespace semfield
