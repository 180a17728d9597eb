// Loss `near_density`: what lies right in front of a camera is empty [Yang23].
#pragma once

#include "core/view.h"
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

// The formula of the near-density loss, for CPU and GPU.

/// How far from the camera the term reaches.
SEMFIELD_HD inline double near_density_reach(double distance_m, double unit_m) {
  constexpr double kReach = 0.3;
  return distance_m > 0 ? distance_m : kReach * unit_m;
}

/// sigma delta of a sample closer than distance_m: a ray's sum is the optical depth there, where [Yang23] takes the
/// mean density of the first samples, which depends on how many there are. An infinite interval counts up to
/// distance_m.
SEMFIELD_HD inline LossValue near_density_share(double t, double delta, double sigma, double distance_m) {
  if (!(t < distance_m)) return {};
  const double length = delta < distance_m ? delta : distance_m;
  return {sigma * length, length};
}

class NearDensityLoss final : public LossOf<NearDensityLoss, NearDensityParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override { return {.moves = {channel::sigma}}; }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    double sum = 0;
    const double reach_m = near_density_reach(params.distance_m, values.unit_m);
    for (std::int64_t r = 0; r + 1 < values.first.rows; ++r) {
      double of_ray = 0;
      for (std::int32_t m = values.first(r, 0); m < values.first(r + 1, 0); ++m) {
        const LossValue share =
            near_density_share(static_cast<double>(values.t(m, 0)), static_cast<double>(values.delta(m, 0)),
                               static_cast<double>(values.sigma(m, 0)), reach_m);
        of_ray += share.value;
        gradients.sigma(m, 0) += static_cast<Real>(scale * share.slope);
      }
      sum += of_ray;
    }
    return sum;
  }
};

}  // namespace semfield
