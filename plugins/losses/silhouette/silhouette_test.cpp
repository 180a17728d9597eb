// The silhouette loss by hand.
#include "losses/silhouette/silhouette.h"

#include <gtest/gtest.h>

#include "testkit/loss_rays.h"

namespace semfield {
namespace {

using testkit::LossRays;

struct Case {
  LossRays<double> rays{{2, 0, 2, 1}};
  Case() {
    rays.weight = {0.2, 0.5, 0.25, 0, 1};
    rays.sum_opacity();
    rays.alpha_target = {1, 1, 0, -1};  // the second ray meets no sample, the last pixel has no alpha
  }
};

TEST(SilhouetteLoss, IsTheSquaredDifferenceFromAlpha) {
  Case c;
  const SilhouetteLoss loss;
  EXPECT_DOUBLE_EQ(c.rays.add(loss, 10), 0.3 * 0.3 + 0.25 * 0.25);
  const std::vector<double> wanted{-6, -6, 5, 5, 0};
  for (std::size_t m = 0; m < wanted.size(); ++m) EXPECT_NEAR(c.rays.d_weight[m], wanted[m], 1e-12) << m;
}

TEST(SilhouetteLoss, CountsRaysWithAKnownAlpha) {
  Case c;
  EXPECT_EQ(SilhouetteLoss().counted_rays(c.rays.targets(), 4), 3);
}

}  // namespace
}  // namespace semfield
