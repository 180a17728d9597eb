// Loss `depth`: what depth images say of where a ray's light comes from.
#pragma once

#include "core/host_device.h"
#include "plugin/loss.h"

namespace semfield {

/// expected       the rendered depth lies where the image says, in units of RayValues::unit_m;
/// line_of_sight  all light comes from within a band about it [Rematas22].
enum class DepthLossKind : std::uint8_t { expected, line_of_sight };
SEMFIELD_CHOICES(DepthLossKind, "expected", "line_of_sight");

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

// The formulas of the depth loss, for CPU and GPU.

/// |D - d| / unit_m, D the rendered and d the true depth along the ray; with truncate_m > 0 an error beyond it costs as
/// much as truncate_m and has no slope: such a pixel is taken for a mistake of the sensor.
SEMFIELD_HD inline LossValue expected_depth_loss(double rendered, double truth, double truncate_m, double unit_m) {
  const double error = rendered - truth;
  const double size = error < 0 ? -error : error;
  if (truncate_m > 0 && size > truncate_m) return {truncate_m / unit_m, 0};
  return {size / unit_m, error > 0 ? 1 / unit_m : error < 0 ? -1 / unit_m : 0.0};
}

/// Half the width of the band of line_of_sight.
SEMFIELD_HD inline double band_of(double band_m, double unit_m) {
  constexpr double kBand = 0.1;
  return band_m > 0 ? band_m : kBand * unit_m;
}

/// 1 - sum of w over |t - d| <= band: the light that does not come from the band, which is what lies in front of it,
/// behind it, and nowhere. The share of one sample, and its slope for w; the ray's 1 is the caller's.
SEMFIELD_HD inline LossValue line_of_sight_share(double t, double weight, double truth, double band_m) {
  const double off = t - truth;
  if (off > band_m || off < -band_m) return {};
  return {-weight, -1};
}

}  // namespace semfield
