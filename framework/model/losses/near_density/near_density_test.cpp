// The near-density loss by hand: the optical depth of the first metres.
#include "model/losses/near_density/near_density.h"

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

}  // namespace
}  // namespace semfield
