// The list of losses: which work, what their means are over, and what a list may not hold.
#include "losses/loss_list.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "plugin/linked_plugins.h"
#include "testkit/loss/loss_rays.h"
#include "testkit/settings.h"

namespace semfield {
namespace {

using testkit::LossRays;

const std::vector<int> kCounts{7, 0, 1, 12, 3, 5};

LossList list_of(const std::vector<std::pair<std::string, testkit::Settings>>& losses) {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    return filled;
  }();
  std::vector<LossEntry> entries;
  for (const auto& [type, settings] : losses) {
    const PluginEntry& entry = registry.get(PluginKind::loss, type);
    entries.push_back({type, entry.loss(*testkit::make_params(entry, settings)), nullptr, "here"});
  }
  return LossList(std::move(entries));
}

TEST(LossList, ActiveLossesAreMeansOverTheRaysThatCount) {
  const LossList list = list_of({{"distortion", {{"weight", "0.5"}}}, {"depth", {{"weight", "0.25"}}}});
  LossRays<double> rays(kCounts);
  const LossScales early = list.scales(2, rays.targets(), rays.rays()), late = list.scales(~0U, rays.targets(), 6);
  EXPECT_EQ(early.active, 2u);
  EXPECT_EQ(late.active, 3u);
  EXPECT_EQ(early.scale[0], 0);
  EXPECT_EQ(late.count[0], 6);
  EXPECT_EQ(late.count[1], 3) << "rays 0, 3 and 4 have depth";
  EXPECT_EQ(late.scale[0], 0.5 / 6);
  EXPECT_EQ(late.scale[1], 0.25 / 3);
  EXPECT_EQ(list.moving(channel::depth), 2u);
  EXPECT_EQ(list.moving(channel::weight), 1u);
  EXPECT_EQ(list.on_logits() | list.on_heads() | list.reading_heads(), 0u);
  LossNumbers sums{};
  list.add(late.active, late, rays.targets(), rays.values(), rays.gradients(), sums);
  LossRays<double> alone(kCounts);
  const double distortion = alone.add(*list.entries()[0].loss, 0), depth = alone.add(*list.entries()[1].loss, 0);
  EXPECT_DOUBLE_EQ(list.finish(late, sums), 0.5 * distortion / 6 + 0.25 * depth / 3);
  EXPECT_DOUBLE_EQ(sums[1], depth / 3);
}

TEST(LossList, ABatchWithoutDepthIsNoLossAndNoDivisionByZero) {
  const LossList list = list_of({{"depth", {}}});
  LossRays<double> rays(kCounts);
  std::fill(rays.depth_target.begin(), rays.depth_target.end(), 0.0F);
  const LossScales scales = list.scales(~0U, rays.targets(), rays.rays());
  LossNumbers sums{};
  list.add(scales.active, scales, rays.targets(), rays.values(), rays.gradients(), sums);
  EXPECT_EQ(list.finish(scales, sums), 0);
  EXPECT_EQ(sums[0], 0);
  for (const double d : rays.d_depth) EXPECT_EQ(d, 0);
}

TEST(LossList, LossesOnLogitsAndOnOtherHeadsAreApart) {
  const LossList list = list_of({{"distortion", {}}, {"cosine_distance", {}}, {"generalised_cross_entropy", {}}});
  EXPECT_EQ(list.on_heads(), 2u);
  EXPECT_EQ(list.reading_heads(), 2u);
  EXPECT_EQ(list.on_logits(), 4u);
}

struct BothParams : LossRule {};
class Both final : public LossOf<Both, BothParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    LossTraits traits;
    traits.moves = {channel::logits, channel::color};
    return traits;
  }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>&, double, const RayGradients<Real>&) const {
    return 0;
  }
};

// Gradients of heads are made before the others where a branch stands between.
TEST(LossList, ALossMovesHeadsOrThePassAndNotBoth) {
  try {
    const LossList list({{"both", std::make_shared<Both>(), nullptr, ""}});
    FAIL() << "it was taken";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    EXPECT_NE(error.message().find("'both'"), std::string::npos) << error.message();
  }
}

}  // namespace
}  // namespace semfield
