// Loss term `near_density`: the first decimetres in front of a camera are empty [Yang23].
#pragma once

#include "losses/loss_term.h"

namespace semfield {

struct NearDensityParams {
  double distance_m = 0.3;
};

void describe(ParamVisitor& visit, NearDensityParams& params);

class NearDensityLoss final : public LossTermOf<NearDensityLoss, NearDensityParams> {
 public:
  /// Begun with the run, or strong, it can end the density of a whole network before colours hold any.
  NearDensityLoss() {
    rule.weight = 0.001;
    rule.from_step = 0.1;
  }

  LossTraits traits() const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
