// Loss `depth`: what depth images say of where a ray's light comes from.
#pragma once

#include "core/view.h"
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

class DepthLoss final : public LossOf<DepthLoss, DepthLossParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    return {.targets = {channel::depth},
            .moves = {params.kind == DepthLossKind::expected ? channel::depth : channel::weight}};
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t) const override {
    std::int64_t known = 0;
    const View<const float> depth = batch.more[channel::depth];
    for (std::int64_t r = 0; r < depth.rows; ++r) known += depth(r, 0) > 0 ? 1 : 0;
    return known;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    double sum = 0;
    const double band_m = band_of(params.band_m, values.unit_m);
    const View<const float> depth = targets.more[channel::depth];
    for (std::int64_t r = 0; r < depth.rows; ++r) {
      const auto truth = static_cast<double>(depth(r, 0));
      if (!(truth > 0)) continue;
      if (params.kind == DepthLossKind::expected) {
        const LossValue loss =
            expected_depth_loss(static_cast<double>(values.depth(r, 0)), truth, params.truncate_m, values.unit_m);
        sum += loss.value;
        gradients.depth(r, 0) += static_cast<Real>(scale * loss.slope);
        continue;
      }
      double of_ray = 1;
      for (std::int32_t m = values.first(r, 0); m < values.first(r + 1, 0); ++m) {
        const LossValue share = line_of_sight_share(static_cast<double>(values.t(m, 0)),
                                                    static_cast<double>(values.weight(m, 0)), truth, band_m);
        of_ray += share.value;
        gradients.weight(m, 0) += static_cast<Real>(scale * share.slope);
      }
      sum += of_ray;
    }
    return sum;
  }
};

}  // namespace semfield
