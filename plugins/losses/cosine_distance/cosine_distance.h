// Loss `cosine_distance`: the angle between a head's channel and the dataset's channel of the same name.
#pragma once

#include <cmath>
#include <string>

#include "core/host_device.h"
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

// The formulas of the cosine distance, for CPU and GPU.

/// Lengths of the rows that a ray compares, and the cosine of their angle.
struct RowAngle {
  double of_target, of_made, cosine;

  /// `scale` times d(cosine)/d(made) of a column: towards the target, across the row that was made.
  SEMFIELD_HD double slope(double scale, double target, double made) const {
    return scale * (target / of_target - cosine * made / of_made) / of_made;
  }
};

/// From squared lengths and product of the two rows. 1e-4 is added to the squared length of what the head makes: its
/// row is almost zero where a ray meets almost nothing, and there the angle would have a slope without bounds. It
/// bounds the slope by 100, and the loss of a row of length 1 by 1e-4.
SEMFIELD_HD inline RowAngle row_angle(double target_square, double made_square, double product) {
  constexpr double kLeastSquare = 1e-4;
  const double of_target = std::sqrt(target_square), of_made = std::sqrt(made_square + kLeastSquare);
  return {of_target, of_made, product / (of_made * of_target)};
}

}  // namespace semfield
