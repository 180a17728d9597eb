// The loss laws hold for a sound loss and catch each broken promise.
#include <gtest/gtest.h>

#include "testkit/laws.h"
#include "tests/plugin/broken_case.h"

namespace semfield {
namespace {

enum class Break {
  none,
  wrong_slope,
  hidden_slope,
  says_more,
  assigns,
  scaled_loss,
  depends_on_row,
  float_off,
  loss_of_nothing,
  needs_no_label,
  pulls_unlabelled,
  counts_unlabelled,
  divides_by_zero,
};

struct ToyParams : LossRule {
  ToyParams() { weight = 1; }
  Break broken = Break::none;
};

/// s_y^2 of the label's logit.
class Toy final : public LossOf<Toy, ToyParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    LossTraits traits;
    traits.targets = {channel::label};
    traits.heads = {channel::logits};
    traits.moves = {channel::logits};
    if (params.broken == Break::says_more) traits.moves.push_back(channel::color);
    return traits;
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override {
    if (params.broken == Break::counts_unlabelled) return rays;
    std::int64_t labelled = 0;
    for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
    return labelled;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const Break b = params.broken;
    const View<const Real> logits = values.heads[channel::logits];
    const View<Real> d_logits = gradients.heads[channel::logits];
    double sum = b == Break::loss_of_nothing ? 0.1 : 0;
    if (targets.label.empty()) return b == Break::needs_no_label ? 1 : sum;
    for (std::int64_t r = 0; r < logits.rows; ++r) {
      const std::int16_t label = targets.label(r, 0);
      if (label < 0 && b == Break::pulls_unlabelled) d_logits(r, 0) += Real(1e-9);
      if (label < 0) continue;
      const auto s = static_cast<double>(logits(r, label));
      double value = s * s, slope = 2 * s;
      if (b == Break::wrong_slope) slope *= 1.001;
      if (b == Break::hidden_slope) value += static_cast<double>(values.color(r, 0));
      if (b == Break::depends_on_row) slope += 1e-5 * static_cast<double>(r);
      if (b == Break::float_off && sizeof(Real) == 4) value *= 1.01;
      if (b == Break::scaled_loss) value *= scale;
      if (b == Break::divides_by_zero && s > 1000) value /= s - 1e4;
      sum += value;
      Real& d = d_logits(r, label);
      d = (b == Break::assigns ? Real(0) : d) + static_cast<Real>(scale * slope);
    }
    return sum;
  }
};

testkit::Failures laws_of(Break broken) {
  ToyParams params;
  params.broken = broken;
  return testkit::loss_laws(Toy(params));
}

TEST(LossLaws, HoldForASoundLoss) { EXPECT_EQ(testkit::to_text(laws_of(Break::none)), ""); }

using Case = BrokenCase<Break>;
class BrokenLoss : public testing::TestWithParam<Case> {};

TEST_P(BrokenLoss, IsCaught) {
  const std::string found = testkit::to_text(laws_of(GetParam().broken));
  EXPECT_NE(found.find(GetParam().law), std::string::npos) << "failures were:\n" << found;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenLoss,
                         testing::Values(Case{Break::wrong_slope, "gradient of logits"},
                                         Case{Break::hidden_slope, "gradient of color"},
                                         Case{Break::says_more, "does not move color"},
                                         Case{Break::assigns, "gradients accumulate, logits"},
                                         Case{Break::scaled_loss, "the loss is before its scale"},
                                         Case{Break::depends_on_row, "rays are independent, gradient of logits"},
                                         Case{Break::float_off, "float against double, loss"},
                                         Case{Break::loss_of_nothing, "no ray: has a loss"},
                                         Case{Break::needs_no_label, "without label: there is a loss"},
                                         Case{Break::pulls_unlabelled, "rays without a label: have a gradient"},
                                         Case{Break::counts_unlabelled, "without label: rays are counted"},
                                         Case{Break::divides_by_zero, "extremes: the loss is not finite"}),
                         NameOfCase{});

}  // namespace
}  // namespace semfield
