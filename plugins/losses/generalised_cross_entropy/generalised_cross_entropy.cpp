#include "losses/generalised_cross_entropy/generalised_cross_entropy.h"

#include <algorithm>

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, GeneralisedCrossEntropyParams& p) {
  SEMFIELD_PARAM(
      visit, p, q,
      "between cross-entropy (towards 0), which trusts every label, and 1, the absolute error, which lets go "
      "of labels that the network contradicts [Zhang18]",
      {0.01, 1});
}

LossTraits GeneralisedCrossEntropy::traits() const {
  LossTraits traits;
  traits.targets = {channel::label};
  traits.heads = {channel::logits};
  traits.moves = {channel::logits};
  return traits;
}

std::int64_t GeneralisedCrossEntropy::counted_rays(const RayTargets& batch, std::int64_t) const {
  std::int64_t labelled = 0;
  for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
  return labelled;
}

namespace {

/// Labels of one ray as shares of classes: a hard one, or a row of soft ones that is divided by its sum.
struct LabelShares {
  std::int32_t hard = -1;
  const float* soft = nullptr;
  double sum = 1;

  double of(std::int32_t c) const {
    if (soft == nullptr) return c == hard ? 1 : 0;
    return static_cast<double>(soft[c]) / sum;
  }
};

// False for a ray without a label.
bool shares_of(const RayTargets& targets, View<const float> soft, std::int64_t ray, LabelShares& out) {
  out.hard = targets.label(ray, 0);
  if (out.hard < 0) return false;
  if (soft.empty()) return true;
  out.soft = soft.row(ray);
  out.sum = 0;
  for (std::int32_t c = 0; c < soft.cols; ++c) out.sum += static_cast<double>(out.soft[c]);
  return out.sum > 0;
}

}  // namespace

template <class Real>
double GeneralisedCrossEntropy::sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
                                    const RayGradients<Real>& gradients) const {
  const View<const Real> logits = values.heads[channel::logits];
  const View<Real> d_logits = gradients.heads[channel::logits];
  const View<const float> soft = targets.more[channel::soft_label];
  if (targets.label.empty()) return 0;
  double sum = 0;
  LabelShares shares;
  for (std::int64_t r = 0; r < logits.rows; ++r) {
    if (!shares_of(targets, soft, r, shares)) continue;
    const Real* const s = logits.row(r);
    const auto largest = static_cast<double>(*std::max_element(s, s + logits.cols));
    const auto below = [&](std::int32_t c) { return static_cast<double>(s[c]) - largest; };
    double total = 0, powers = 0;
    for (std::int32_t c = 0; c < logits.cols; ++c) total += std::exp(below(c));
    for (std::int32_t c = 0; c < logits.cols; ++c) {
      const double t = shares.of(c);
      if (t == 0) continue;
      const double power = power_of_probability(below(c), total, params.q);
      powers += t * power;
      sum += generalised_share(t, power, params.q);
    }
    for (std::int32_t c = 0; c < logits.cols; ++c) {
      const double t = shares.of(c);
      const double power = t == 0 ? 0 : power_of_probability(below(c), total, params.q);
      d_logits(r, c) += static_cast<Real>(scale * generalised_slope(std::exp(below(c)) / total, powers, t, power));
    }
  }
  return sum;
}

template double GeneralisedCrossEntropy::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                                    const RayGradients<float>&) const;
template double GeneralisedCrossEntropy::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                                     const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(generalised_cross_entropy, "1.0", [](Registry& registry) {
  registry.add_loss<GeneralisedCrossEntropy>(
      "generalised_cross_entropy",
      "Class labels many of which may be wrong: (1 - p^q) / q of the label's class [Zhang18].",
      "an exponential per class and labelled ray");
})

}  // namespace semfield
