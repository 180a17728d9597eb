// Loss `generalised_cross_entropy`: between cross-entropy and the absolute error, for noisy labels [Zhang18].
#pragma once

#include <cmath>

#include "core/host_device.h"
#include "plugin/loss.h"

namespace semfield {

struct GeneralisedCrossEntropyParams : LossRule {
  GeneralisedCrossEntropyParams() { weight = 0.08; }
  double q = 0.3;
};
void describe(ParamVisitor& visit, GeneralisedCrossEntropyParams& p);

class GeneralisedCrossEntropy final : public LossOf<GeneralisedCrossEntropy, GeneralisedCrossEntropyParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

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

}  // namespace semfield
