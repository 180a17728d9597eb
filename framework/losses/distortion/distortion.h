// Loss `distortion`: light of a ray comes from one place [Barron22, Eq. 15].
#pragma once

#include <array>

#include "plugin/loss.h"

namespace semfield {

/// How distances are brought to [0, 1] between the ray's own near and far.
///   linear     (t - near) / (far - near);
///   disparity  the same of 1 / t, which spreads what is close [Barron22].
enum class DistortionSpace : std::uint8_t { linear, disparity };
template <>
struct ChoiceNames<DistortionSpace> {
  static constexpr std::array<std::string_view, 2> names{"linear", "disparity"};
};

struct DistortionParams : LossRule {
  DistortionParams() {
    weight = 0.002;
    from_step = 0.2;
  }
  DistortionSpace space = DistortionSpace::linear;
};

void describe(ParamVisitor& visit, DistortionParams& params);

class DistortionLoss final : public LossOf<DistortionLoss, DistortionParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
