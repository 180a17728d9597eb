// The cosine by hand.
#include "losses/cosine_distance/cosine_distance.h"

#include <gtest/gtest.h>

namespace semfield {
namespace {

struct Rows {
  std::vector<float> target;
  std::vector<double> made, d_made = std::vector<double>(made.size(), 0);
  double add(double scale = 1) {
    const auto rays = static_cast<std::int64_t>(made.size()) / 2;
    RayTargets targets;
    targets.more.set("feature", {target.data(), rays, 2});
    RayValues<double> values;
    values.heads.set("feature", {made.data(), rays, 2});
    RayGradients<double> gradients;
    gradients.heads.set("feature", {d_made.data(), rays, 2});
    const CosineDistance loss;
    counted = loss.counted_rays(targets, rays);
    return loss.add(targets, values, scale, gradients);
  }
  std::int64_t counted = 0;
};

TEST(CosineDistance, IsOneMinusTheCosineWhateverTheLengths) {
  Rows same{{2, 0}, {5, 0}}, across{{0, 3}, {7, 0}}, against{{1, 1}, {-4, -4}};
  EXPECT_NEAR(same.add(), 0, 1e-5);
  EXPECT_NEAR(across.add(), 1, 1e-5);
  EXPECT_NEAR(against.add(), 2, 1e-5);
  EXPECT_NEAR(across.d_made[1], -1.0 / 7, 1e-6) << "towards the target, over the length";
  EXPECT_NEAR(across.d_made[0], 0, 1e-6);
}

TEST(CosineDistance, ARowOfZerosCountsForNothing) {
  Rows rows{{0, 0, 1, 0}, {1, 2, 0, 0}};
  EXPECT_NEAR(rows.add(), 1, 1e-12) << "of a row that the head leaves empty";
  EXPECT_EQ(rows.counted, 1);
  EXPECT_EQ(rows.d_made[0], 0);
  EXPECT_NEAR(rows.d_made[2], -100, 1e-9) << "the bound of the slope";
}

TEST(CosineDistance, ReadsAndMovesTheChannelThatItNames) {
  CosineDistanceParams params;
  params.channel = "clip";
  const CosineDistance loss(params);
  const LossTraits traits = loss.traits();
  EXPECT_TRUE(traits.reads_target("clip") && traits.reads_head("clip") && traits.does_move("clip"));
  EXPECT_EQ(traits.moves.size(), 1U);
}

}  // namespace
}  // namespace semfield
