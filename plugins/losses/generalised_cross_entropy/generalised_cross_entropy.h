// Loss `generalised_cross_entropy`: between cross-entropy and the absolute error, for noisy labels [Zhang18].
#pragma once

#include <algorithm>
#include <cmath>

#include "core/view.h"
#include "plugin/loss.h"

namespace semfield {

struct GeneralisedCrossEntropyParams : LossRule {
  GeneralisedCrossEntropyParams() { weight = 0.08; }
  double q = 0.3;
};
void describe(ParamVisitor& visit, GeneralisedCrossEntropyParams& p);

// The formulas of the generalised cross-entropy, for CPU and GPU.

/// p^q of a class whose logit lies `below` the row's largest, of which `total` = sum of e^(s_c - largest).
SEMFIELD_HD inline double power_of_probability(double below, double total, double q) {
  return std::exp(q * (below - std::log(total)));
}

/// What a class with label share t adds to the loss of its row: t (1 - p^q) / q [Zhang18 Eq. 6].
SEMFIELD_HD inline double generalised_share(double t, double power, double q) { return t * (1 - power) / q; }

/// dL/d(s_c) = p_c A - t_c p_c^q, A = sum over classes of t p^q.
SEMFIELD_HD inline double generalised_slope(double p, double sum_of_powers, double t, double power) {
  return p * sum_of_powers - t * power;
}

class GeneralisedCrossEntropy final : public LossOf<GeneralisedCrossEntropy, GeneralisedCrossEntropyParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    return {.targets = {channel::label}, .heads = {channel::logits}, .moves = {channel::logits}};
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t) const override {
    std::int64_t labelled = 0;
    for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
    return labelled;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
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

 private:
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
  static bool shares_of(const RayTargets& targets, View<const float> soft, std::int64_t ray, LabelShares& out) {
    out.hard = targets.label(ray, 0);
    if (out.hard < 0) return false;
    if (soft.empty()) return true;
    out.soft = soft.row(ray);
    out.sum = 0;
    for (std::int32_t c = 0; c < soft.cols; ++c) out.sum += static_cast<double>(out.soft[c]);
    return out.sum > 0;
  }
};

}  // namespace semfield
