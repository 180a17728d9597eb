// Loss `generalised_cross_entropy`: between cross-entropy and the absolute error, for noisy labels [Zhang18].
#pragma once

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

}  // namespace semfield
