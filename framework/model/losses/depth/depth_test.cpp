// The depth loss by hand: both kinds, truncation, the band, pixels without depth.
#include "model/losses/depth/depth.h"

#include <gtest/gtest.h>

#include "testkit/loss_rays.h"

namespace semfield {
namespace {

using testkit::LossRays;

struct Case {
  LossRays<double> rays{{3, 3}};
  Case() {
    rays.t = {1, 2, 3, 1, 2, 3};
    rays.weight = {0.2, 0.5, 0.1, 0, 1, 0};
    rays.depth = {1.5, 2};
    rays.depth_target = {2, 0};  // the second pixel has none
  }
};

TEST(DepthLoss, ExpectedIsTheErrorOfTheRenderedDepth) {
  Case c;
  const DepthLoss loss;
  EXPECT_EQ(loss.counted_rays(c.rays.targets(), 2), 1);
  EXPECT_EQ(c.rays.add(loss, 10), 0.5);
  EXPECT_EQ(c.rays.d_depth, (std::vector<double>{-10, 0})) << "further away, and nothing for a pixel without depth";
}

TEST(DepthLoss, AnErrorBeyondTheTruncationHasNoSlope) {
  Case c;
  DepthLoss loss;
  loss.params.truncate_m = 0.25;
  EXPECT_EQ(c.rays.add(loss, 10), 0.25);
  EXPECT_EQ(c.rays.d_depth, (std::vector<double>{0, 0}));
}

TEST(DepthLoss, LineOfSightIsTheLightFromOutsideTheBand) {
  Case c;
  DepthLoss loss;
  loss.params.kind = DepthLossKind::line_of_sight;
  loss.params.band_m = 0.5;
  EXPECT_DOUBLE_EQ(c.rays.add(loss, 10), 0.5) << "0.2 in front, 0.1 behind, 0.2 that meets nothing";
  EXPECT_EQ(c.rays.d_weight, (std::vector<double>{0, -10, 0, 0, 0, 0}));
}

}  // namespace
}  // namespace semfield
