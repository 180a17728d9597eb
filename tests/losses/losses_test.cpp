// Losses: class weights, gradients, the list. Cases D01 to D10 of tests/numerics compare cross-entropy with long
// double.
#include "core/error.h"
#include "core/rng.h"
#include "losses/loss_list.h"
#include "losses/semantic_cross_entropy.h"
#include "plugin/loader.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "testkit/loss_rays.h"
#include "tests/says.h"

namespace semfield {
namespace {

using testkit::LossRays;

double uniform(std::uint64_t i) { return static_cast<double>(uniform01({5, 0, stream_id("loss test")}, i)); }

template <class Real>
struct Run {
  SemanticLoss loss;
  std::vector<Real> d;
};

template <class Real>
Run<Real> run_hard(const std::vector<Real>& logits, int classes, const std::vector<std::int16_t>& labels,
                   double normaliser, double scale = 1, const std::vector<float>& weights = {}) {
  Run<Real> run;
  run.d.assign(logits.size(), Real(7));
  const auto rows = static_cast<std::int64_t>(labels.size());
  SemanticTargets targets{.hard = View<const std::int16_t>(labels.data(), rows, 1)};
  const View<const float> w = weights.empty() ? View<const float>() : View<const float>(weights.data(), 1, classes);
  run.loss = semantic_cross_entropy<Real>(View<const Real>(logits.data(), rows, classes), targets, w, normaliser, scale,
                                          View<Real>(run.d.data(), rows, classes));
  return run;
}

template <class Real>
Run<Real> run_soft(const std::vector<Real>& logits, int classes, const std::vector<float>& soft, double normaliser) {
  Run<Real> run;
  run.d.assign(logits.size(), Real(7));
  const auto rows = static_cast<std::int64_t>(logits.size()) / classes;
  SemanticTargets targets{.soft = View<const float>(soft.data(), rows, classes)};
  run.loss = semantic_cross_entropy<Real>(View<const Real>(logits.data(), rows, classes), targets, {}, normaliser, 1,
                                          View<Real>(run.d.data(), rows, classes));
  return run;
}

TEST(Photometric, SumOfSquaresAndGradient) {
  const std::vector<double> color{0.5, 0.25, 1, 0, 0, 0};
  const std::vector<float> target{0, 0.25f, 0.5f, 1, 0, 0};
  std::vector<double> d(6, 9);
  const double sum =
      photometric_loss<double>(View<const double>(color.data(), 2, 3), View<const float>(target.data(), 2, 3), 6, 0.5,
                               View<double>(d.data(), 2, 3));
  EXPECT_DOUBLE_EQ(sum, 0.25 + 0.25 + 1);
  EXPECT_EQ(d, (std::vector<double>{0.5 / 6, 0, 0.5 / 6, -1.0 / 6, 0, 0}));
  EXPECT_EQ(photometric_loss<float>({nullptr, 0, 3}, {nullptr, 0, 3}, 1, 1, {}), 0);  // B12
}

TEST(CrossEntropy, AnUnlabelledRowIsNotRead) {
  EXPECT_NO_THROW(run_hard<float>({0, 1, 2, 0, std::numeric_limits<float>::infinity(), 2}, 3, {0, -1}, 1));
}

TEST(CrossEntropy, ASoftRowOfOneClassIsThatLabel) {
  const std::vector<double> logits{0.3, -0.2, 1.1};
  const auto one_hot = run_soft<double>(logits, 3, {0, 1, 0}, 1);
  const auto hard = run_hard<double>(logits, 3, {1}, 1);
  EXPECT_NEAR(one_hot.loss.sum, hard.loss.sum, 1e-15);
  for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(one_hot.d[c], hard.d[c], 1e-15);
}

TEST(CrossEntropy, ClassWeights) {
  const std::vector<double> logits{0, 1, 2, 0, 1, 2};
  const auto plain = run_hard<double>(logits, 3, {1, 2}, 1);
  const auto weighted = run_hard<double>(logits, 3, {1, 2}, 1, 1, {1, 2, 5});
  EXPECT_NEAR(weighted.d[0], 2 * plain.d[0], 1e-14);
  EXPECT_NEAR(weighted.d[3], 5 * plain.d[3], 1e-14);
  const std::vector<std::int16_t> labels{1, 2, -1};
  const std::vector<float> w{1, 2, 5};
  SemanticTargets targets{.hard = View<const std::int16_t>(labels.data(), 3, 1)};
  EXPECT_EQ(labelled_weight(targets, View<const float>(w.data(), 1, 3)), 7);
}

TEST(CrossEntropy, GradientAgainstFiniteDifferences) {
  constexpr int kRays = 5, kClasses = 7;
  std::vector<double> logits;
  std::vector<float> soft, weights;
  for (std::uint64_t i = 0; i < kRays * kClasses; ++i) {
    logits.push_back(6 * uniform(i) - 3);
    soft.push_back(i / kClasses == 2 ? 0.f : static_cast<float>(uniform(1000 + i)));
  }
  for (std::uint64_t c = 0; c < kClasses; ++c) weights.push_back(static_cast<float>(0.5 + uniform(2000 + c)));
  const std::vector<std::int16_t> hard{0, 6, -1, 3, 3};
  for (const bool is_hard : {true, false}) {
    SemanticTargets targets;
    if (is_hard) targets.hard = View<const std::int16_t>(hard.data(), kRays, 1);
    if (!is_hard) targets.soft = View<const float>(soft.data(), kRays, kClasses);
    const View<const float> w(weights.data(), 1, kClasses);
    std::vector<double> d(logits.size());
    const View<double> x(logits.data(), kRays, kClasses), dx(d.data(), kRays, kClasses);
    semantic_cross_entropy<double>(x, targets, w, 4, 0.04, dx);
    const auto loss = [&] { return 0.04 / 4 * semantic_cross_entropy<double>(x, targets, w, 4, 0.04, {}).sum; };
    EXPECT_EQ(testkit::check_gradient(loss, x, dx, {1e-8, 1e-6, 100, 1}), "");
  }
}

// The list of losses: which work, what their means are over, and what a list may not hold.

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
  EXPECT_HAS(error_of(ErrorKind::config,
                      [&] {
                        const LossList list({{"both", std::make_shared<Both>(), nullptr, ""}});
                      }),
             "'both'");
}

}  // namespace
}  // namespace semfield
