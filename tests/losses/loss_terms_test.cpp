// The laws of every term that `losses` may name.
#include <gtest/gtest.h>

#include <cmath>

#include "losses/loss_list.h"
#include "testkit/compare.h"
#include "testkit/gradient_check.h"
#include "tests/losses/loss_rays.h"

namespace semfield {
namespace {

using testing::LossRays;
using testing::LossSetting;

constexpr double kScale = 0.37;
const std::vector<int> kCounts{7, 0, 1, 12, 3, 5};

template <class Real>
View<const Real> column(const std::vector<Real>& v) {
  return View<const Real>(v.data(), static_cast<std::int64_t>(v.size()), 1);
}

class LossLaws : public ::testing::TestWithParam<LossSetting> {};

// Of every value that a term sees, moved by its traits or not: a slope that it does not give must be none.
TEST_P(LossLaws, GradientsAreCentralDifferences) {
  const LossTerm& term = *GetParam().term;
  LossRays<double> rays(kCounts);
  rays.add(term, kScale);
  LossRays<double> at = rays;
  const auto loss = [&] {
    LossRays<double> copy = at;
    return kScale * copy.add(term, 0);
  };
  const testkit::GradientCheck options{1e-7, 1e-6, 400, 1};
  const auto check = [&](const char* what, std::vector<double>& x, const std::vector<double>& gradient) {
    EXPECT_EQ(testkit::check_gradient(loss, LossRays<double>::mat(x, 1), column(gradient), options), "") << what;
  };
  check("colour", at.color, rays.d_color);
  check("depth", at.depth, rays.d_depth);
  check("weight", at.weight, rays.d_weight);
  check("density", at.sigma, rays.d_sigma);
}

TEST_P(LossLaws, MovesWhatItsTraitsSayAndNothingElse) {
  const LossTraits traits = GetParam().term->traits();
  LossRays<double> rays(testing::awkward_ray_lengths());
  EXPECT_GT(rays.add(*GetParam().term, kScale), 0);
  const auto moves = [](const std::vector<double>& gradient) {
    return std::any_of(gradient.begin(), gradient.end(), [](double d) { return d != 0; });
  };
  EXPECT_EQ(moves(rays.d_color), traits.moves_color);
  EXPECT_EQ(moves(rays.d_depth), traits.moves_depth);
  EXPECT_EQ(moves(rays.d_weight), traits.moves_weight);
  EXPECT_EQ(moves(rays.d_sigma), traits.moves_sigma);
}

TEST_P(LossLaws, FloatAgreesWithDouble) {
  const LossTerm& term = *GetParam().term;
  LossRays<float> narrow(testing::awkward_ray_lengths());
  LossRays<double> wide(testing::awkward_ray_lengths());
  const double sum = wide.add(term, kScale);
  EXPECT_NEAR(narrow.add(term, kScale), sum, 1e-5 * sum);
  EXPECT_EQ(testkit::compare(column(narrow.d_depth), column(wide.d_depth), 1e-5), "");
  EXPECT_EQ(testkit::compare(column(narrow.d_weight), column(wide.d_weight), 1e-5), "");
  EXPECT_EQ(testkit::compare(column(narrow.d_sigma), column(wide.d_sigma), 1e-5), "");
}

TEST_P(LossLaws, AddsToGradientsAndScalesThem) {
  const LossTerm& term = *GetParam().term;
  LossRays<double> once(kCounts), thrice(kCounts);
  const double sum = once.add(term, 1);
  EXPECT_EQ(thrice.add(term, 1), sum);
  EXPECT_EQ(thrice.add(term, 2), sum) << "the sum is before the scale";
  for (std::size_t i = 0; i < once.d_weight.size(); ++i) {
    EXPECT_NEAR(thrice.d_weight[i], 3 * once.d_weight[i], 1e-12);
    EXPECT_NEAR(thrice.d_sigma[i], 3 * once.d_sigma[i], 1e-12);
  }
  for (std::size_t i = 0; i < once.d_depth.size(); ++i) EXPECT_NEAR(thrice.d_depth[i], 3 * once.d_depth[i], 1e-12);
}

TEST_P(LossLaws, ARayDependsOnItselfAlone) {
  const LossTerm& term = *GetParam().term;
  LossRays<float> whole(testing::awkward_ray_lengths()), parts(testing::awkward_ray_lengths());
  const double sum = whole.add(term, kScale);
  double of_parts = 0;
  for (std::int64_t r = 0; r < parts.rays(); r += 5) {
    const std::int64_t count = std::min<std::int64_t>(5, parts.rays() - r);
    of_parts += term.add(parts.targets(r, count), parts.values(r, count), kScale, parts.gradients(r, count));
  }
  EXPECT_NEAR(of_parts, sum, 1e-12 * sum);
  EXPECT_EQ(parts.d_depth, whole.d_depth);
  EXPECT_EQ(parts.d_weight, whole.d_weight);
  EXPECT_EQ(parts.d_sigma, whole.d_sigma);
}

TEST_P(LossLaws, NoRayAndNoSampleAreNoLoss) {
  for (const std::vector<int>& counts : std::vector<std::vector<int>>{{}, {0}, {0, 0}}) {
    LossRays<float> rays(counts);
    EXPECT_EQ(rays.add(*GetParam().term, kScale), 0);
  }
}

TEST_P(LossLaws, NoTargetsAreNoLossWhereTheyAreRead) {
  const LossTerm& term = *GetParam().term;
  LossRays<float> rays(kCounts);
  const double sum = term.add({}, rays.values(), kScale, rays.gradients());
  if (term.traits().reads_depth) {
    EXPECT_EQ(sum, 0);
    EXPECT_EQ(term.counted_rays({}, rays.rays()), 0);
  }
}

// An interval without an end, a near of 0 and weights of 0 give finite numbers.
TEST_P(LossLaws, ExtremesStayFinite) {
  LossRays<float> rays({4, 3, 2});
  for (std::size_t r = 0; r < 3; ++r) rays.near_far[2 * r] = 0;
  rays.t = {0, 1, 1, 2, 0, 0, 0, 1e-30F, 3};
  rays.delta[3] = rays.delta[8] = INFINITY;
  rays.weight = {0, 1, 0, 0, 0, 0, 0, 0.5F, 0.5F};
  EXPECT_TRUE(std::isfinite(rays.add(*GetParam().term, kScale)));
  for (const std::vector<float>* gradient : {&rays.d_depth, &rays.d_weight, &rays.d_sigma}) {
    for (const float d : *gradient) EXPECT_TRUE(std::isfinite(d));
  }
}

INSTANTIATE_TEST_SUITE_P(All, LossLaws, ::testing::ValuesIn(testing::loss_settings()),
                         [](const ::testing::TestParamInfo<LossSetting>& row) { return row.param.name; });

TEST(LossList, HoldsEveryKindAtOnce) {
  EXPECT_LE(loss_kinds().size(), kMostLossTerms);
  for (const LossKind& kind : loss_kinds()) {
    EXPECT_FALSE(kind.sentence.empty() || kind.cost.empty()) << kind.type;
    EXPECT_GT(kind.make()->rule.weight, 0) << kind.type << ": a term that is named works";
  }
}

LossList list_of(const std::vector<std::pair<std::string, LossRule>>& terms) {
  std::vector<LossEntry> entries;
  for (const auto& [type, rule] : terms) {
    for (const LossKind& kind : loss_kinds()) {
      if (kind.type != type) continue;
      entries.push_back({type, kind.make(), "here"});
      entries.back().term->rule = rule;
    }
  }
  return LossList(std::move(entries));
}

TEST(LossList, ActiveTermsAreMeansOverTheRaysThatCount) {
  const LossList list = list_of({{"distortion", {0.5, 0.2}}, {"depth", {0.25, 0}}});
  LossRays<double> rays(kCounts);
  const LossScales early = list.scales(2, rays.targets(), rays.rays()), late = list.scales(~0U, rays.targets(), 6);
  EXPECT_EQ(early.active, 2u);
  EXPECT_EQ(late.active, 3u);
  EXPECT_EQ(early.scale[0], 0);
  EXPECT_EQ(late.count[0], 6);
  EXPECT_EQ(late.count[1], 3) << "rays 0, 3 and 4 have depth";
  EXPECT_EQ(late.scale[0], 0.5 / 6);
  EXPECT_EQ(late.scale[1], 0.25 / 3);
  EXPECT_TRUE(list.traits(early.active).moves_depth);
  EXPECT_FALSE(list.traits(early.active).moves_weight);
  LossNumbers sums{};
  list.add(late, rays.targets(), rays.values(), rays.gradients(), sums);
  LossRays<double> alone(kCounts);
  const double distortion = alone.add(*list.entries()[0].term, 0), depth = alone.add(*list.entries()[1].term, 0);
  EXPECT_DOUBLE_EQ(list.finish(late, sums), 0.5 * distortion / 6 + 0.25 * depth / 3);
  EXPECT_DOUBLE_EQ(sums[1], depth / 3);
}

TEST(LossList, ABatchWithoutDepthIsNoLossAndNoDivisionByZero) {
  const LossList list = list_of({{"depth", {0.25, 0}}});
  LossRays<double> rays(kCounts);
  std::fill(rays.depth_target.begin(), rays.depth_target.end(), 0.0F);
  const LossScales scales = list.scales(~0U, rays.targets(), rays.rays());
  LossNumbers sums{};
  list.add(scales, rays.targets(), rays.values(), rays.gradients(), sums);
  EXPECT_EQ(list.finish(scales, sums), 0);
  EXPECT_EQ(sums[0], 0);
  for (const double d : rays.d_depth) EXPECT_EQ(d, 0);
}

}  // namespace
}  // namespace semfield
