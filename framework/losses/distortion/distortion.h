// Loss term `distortion`: light of a ray comes from one place [Barron22, Eq. 15].
#pragma once

#include <array>

#include "losses/loss_term.h"

namespace semfield {

/// How distances are brought to [0, 1] between the ray's own near and far.
///   linear     (t - near) / (far - near);
///   disparity  the same of 1 / t, which spreads what is close [Barron22].
enum class DistortionSpace : std::uint8_t { linear, disparity };
template <>
struct ChoiceNames<DistortionSpace> {
  static constexpr std::array<std::string_view, 2> names{"linear", "disparity"};
};

struct DistortionParams {
  DistortionSpace space = DistortionSpace::linear;
};

void describe(ParamVisitor& visit, DistortionParams& params);

class DistortionLoss final : public LossTermOf<DistortionLoss, DistortionParams> {
 public:
  DistortionLoss() {
    rule.weight = 0.002;
    rule.from_step = 0.2;
  }

  LossTraits traits() const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
