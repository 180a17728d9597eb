#include "losses/near_density/near_density.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, NearDensityParams& p) {
  SEMFIELD_PARAM(visit, p, distance_m,
                 "how far from the camera the term reaches, metres along the ray; 0: 0.3 of rendering.unit_m",
                 {0, 1e12});
}

LossTraits NearDensityLoss::traits() const {
  LossTraits traits;
  traits.moves = {channel::sigma};
  return traits;
}

template <class Real>
double NearDensityLoss::sum(const RayTargets&, const RayValues<Real>& values, double scale,
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

template double NearDensityLoss::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                            const RayGradients<float>&) const;
template double NearDensityLoss::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                             const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(near_density, "1.0", [](Registry& registry) {
  registry.add_loss<NearDensityLoss>(
      "near_density", "what lies right in front of a camera is empty [Yang23]; begun early it can end all density",
      "a gradient per sample");
})

}  // namespace semfield
