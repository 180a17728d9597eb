// Loss `silhouette`: what transparent images say of where the subject is.
#pragma once

#include "plugin/loss.h"

namespace semfield {

struct SilhouetteParams : LossRule {
  SilhouetteParams() { weight = 0.1; }
};
void describe(ParamVisitor& visit, SilhouetteParams& p);

/// The squared difference between a ray's opacity and its pixel's alpha; rays without a known alpha do not count.
class SilhouetteLoss final : public LossOf<SilhouetteLoss, SilhouetteParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
