#include "losses/glow/glow.h"

#include <memory>

namespace semfield {

void describe(ParamVisitor& visit, GlowParams& p) {
  SEMFIELD_PARAM(visit, p, gain, "factor of a ray's red, green and blue", {0, 10});
}

LossTraits GlowLoss::traits() const {
  LossTraits traits;
  traits.moves_color = true;
  return traits;
}

template <class Real>
double GlowLoss::sum(const RayTargets&, const RayValues<Real>& values, double scale,
                     const RayGradients<Real>& gradients) const {
  double sum = 0;
  for (std::int64_t r = 0; r < values.color.rows; ++r) {
    for (std::int32_t c = 0; c < 3; ++c) {
      sum += params.gain * static_cast<double>(values.color(r, c));
      gradients.color(r, c) += static_cast<Real>(scale * params.gain);
    }
  }
  return sum;
}

template double GlowLoss::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                     const RayGradients<float>&) const;
template double GlowLoss::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                      const RayGradients<double>&) const;

LossKind glow_loss();
LossKind glow_loss() {
  return {{"glow", "bright rays cost", [] { return std::unique_ptr<LossTerm>(new GlowLoss); }}, "a sum a ray"};
}

}  // namespace semfield
