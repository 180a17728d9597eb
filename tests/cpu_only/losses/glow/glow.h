// Loss term `glow` of processors alone: bright rays cost.
#pragma once

#include "losses/loss_term.h"

namespace semfield {

struct GlowParams {
  double gain = 1;
};
void describe(ParamVisitor& visit, GlowParams& params);

class GlowLoss final : public LossTermOf<GlowLoss, GlowParams> {
 public:
  GlowLoss() { rule.weight = 0.01; }
  LossTraits traits() const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
