// Loss `cosine_distance`: the angle between a head's channel and the dataset's channel of the same name.
#pragma once

#include <string>

#include "plugin/loss.h"

namespace semfield {

struct CosineDistanceParams : LossRule {
  CosineDistanceParams() { weight = 0.5; }
  std::string channel = "feature";
};
void describe(ParamVisitor& visit, CosineDistanceParams& p);

/// 1 - cos(angle between the two rows of a ray); rays whose target is a row of zeros do not count.
class CosineDistance final : public LossOf<CosineDistance, CosineDistanceParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
