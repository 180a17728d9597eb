#include "losses/distortion/distortion.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, DistortionParams& p) {
  SEMFIELD_PARAM(visit, p, space, "how distances along a ray are mapped to [0, 1]: linearly, or by 1 / t [Barron22]");
}

LossTraits DistortionLoss::traits() const {
  LossTraits traits;
  traits.moves = {channel::weight};
  return traits;
}

template <class Real>
double DistortionLoss::sum(const RayTargets&, const RayValues<Real>& values, double scale,
                           const RayGradients<Real>& gradients) const {
  double sum = 0;
  for (std::int64_t r = 0; r + 1 < values.first.rows; ++r) {
    const std::int32_t begin = values.first(r, 0), end = values.first(r + 1, 0);
    const DistortionMap map(params.space, values.near_far(r, 0), values.near_far(r, 1));
    DistortionWalk front, back;
    double of_ray = 0;
    for (std::int32_t m = begin; m < end; ++m) {
      const auto w = static_cast<double>(values.weight(m, 0)), t = static_cast<double>(values.t(m, 0));
      const double length = map.length(t, static_cast<double>(values.delta(m, 0)));
      const double before = front.step(map.place(t), w);
      of_ray += w * (2 * before + w * length / 3);
      gradients.weight(m, 0) += static_cast<Real>(scale * 2 * (before + w * length / 3));
    }
    for (std::int32_t m = end; m-- > begin;) {
      const auto w = static_cast<double>(values.weight(m, 0)), t = static_cast<double>(values.t(m, 0));
      gradients.weight(m, 0) += static_cast<Real>(scale * 2 * back.step(map.place(t), w));
    }
    sum += of_ray;
  }
  return sum;
}

template double DistortionLoss::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                           const RayGradients<float>&) const;
template double DistortionLoss::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                            const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(distortion, "1.0", [](Registry& registry) {
  registry.add_loss<DistortionLoss>(
      "distortion", "light of a ray comes from one place [Barron22, Eq. 15]; begun early it condenses fog",
      "two walks along each ray and the gradient of its weights");
})

}  // namespace semfield
