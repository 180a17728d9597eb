// Loss `depth`: what depth images say of where a ray's light comes from.
#pragma once

#include <array>

#include "plugin/loss.h"

namespace semfield {

/// expected       the rendered depth lies where the image says, in units of RayValues::unit_m;
/// line_of_sight  all light comes from within a band about it [Rematas22].
enum class DepthLossKind : std::uint8_t { expected, line_of_sight };
template <>
struct ChoiceNames<DepthLossKind> {
  static constexpr std::array<std::string_view, 2> names{"expected", "line_of_sight"};
};

struct DepthLossParams : LossRule {
  DepthLossParams() { weight = 0.1; }
  DepthLossKind kind = DepthLossKind::expected;
  double truncate_m = 0;
  double band_m = 0;  ///< 0: a tenth of the unit
};

void describe(ParamVisitor& visit, DepthLossParams& params);

class DepthLoss final : public LossOf<DepthLoss, DepthLossParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override;
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override;
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const;
};

}  // namespace semfield
