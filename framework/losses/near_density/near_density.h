// Loss `near_density`: what lies right in front of a camera is empty [Yang23].
#pragma once

#include "plugin/loss.h"

namespace semfield {

struct NearDensityParams : LossRule {
  /// Begun with the run, or strong, it can end the density of a whole network before colours hold any.
  NearDensityParams() {
    weight = 0.001;
    from_step = 0.1;
  }
  double distance_m = 0;
};

void describe(ParamVisitor& visit, NearDensityParams& params);

class NearDensityLoss final : public LossOf<NearDensityLoss, NearDensityParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
