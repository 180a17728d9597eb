// Loss `cosine_distance`: the angle between a head's channel and the dataset's channel of the same name.
#pragma once

#include <cmath>
#include <string>

#include "core/view.h"
#include "plugin/loss.h"

namespace semfield {

struct CosineDistanceParams : LossRule {
  CosineDistanceParams() { weight = 0.5; }
  std::string channel = "feature";
};
void describe(ParamVisitor& visit, CosineDistanceParams& p);

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

/// 1 - cos(angle between the two rows of a ray); rays whose target is a row of zeros do not count.
class CosineDistance final : public LossOf<CosineDistance, CosineDistanceParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    return {.targets = {params.channel}, .heads = {params.channel}, .moves = {params.channel}};
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t) const override {
    const View<const float> target = batch.more[params.channel];
    std::int64_t counted = 0;
    for (std::int64_t r = 0; r < target.rows; ++r) counted += product(target, target, r) > 0 ? 1 : 0;
    return counted;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const View<const float> target = targets.more[params.channel];
    const View<const Real> made = values.heads[params.channel];
    const View<Real> d_made = gradients.heads[params.channel];
    if (target.empty()) return 0;
    double sum = 0;
    for (std::int64_t r = 0; r < made.rows; ++r) {
      const double target_square = product(target, target, r);
      if (!(target_square > 0)) continue;
      const RowAngle angle = row_angle(target_square, product(made, made, r), product(made, target, r));
      sum += 1 - angle.cosine;
      for (std::int32_t c = 0; c < made.cols; ++c)
        d_made(r, c) -=
            static_cast<Real>(angle.slope(scale, static_cast<double>(target(r, c)), static_cast<double>(made(r, c))));
    }
    return sum;
  }

 private:
  template <class Real, class Other>
  static double product(View<const Real> a, View<const Other> b, std::int64_t row) {
    double sum = 0;
    for (std::int32_t c = 0; c < a.cols; ++c) sum += static_cast<double>(a(row, c)) * static_cast<double>(b(row, c));
    return sum;
  }
};

}  // namespace semfield
