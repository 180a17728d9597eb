#include "losses/depth/depth.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, DepthLossParams& p) {
  SEMFIELD_PARAM(visit, p, kind,
                 "expected: the error of the rendered depth, in units of rendering.unit_m; line_of_sight: the share of "
                 "a ray's light from "
                 "outside a band about the true depth [Rematas22]");
  SEMFIELD_PARAM(visit, p, truncate_m,
                 "for kind expected: errors beyond this many metres have no gradient; 0: every error has one",
                 {0, 1e12});
  SEMFIELD_PARAM(
      visit, p, band_m,
      "for kind line_of_sight: half the width of the band, metres, wider than the spacing of samples; 0: a tenth of "
      "rendering.unit_m",
      {0, 1e12});
}

LossTraits DepthLoss::traits() const {
  LossTraits traits;
  traits.targets = {channel::depth};
  traits.moves = {params.kind == DepthLossKind::expected ? channel::depth : channel::weight};
  return traits;
}

std::int64_t DepthLoss::counted_rays(const RayTargets& batch, std::int64_t) const {
  std::int64_t known = 0;
  const View<const float> depth = batch.more[channel::depth];
  for (std::int64_t r = 0; r < depth.rows; ++r) known += depth(r, 0) > 0 ? 1 : 0;
  return known;
}

template <class Real>
double DepthLoss::sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
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

template double DepthLoss::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                      const RayGradients<float>&) const;
template double DepthLoss::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                       const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(depth, "1.0", [](Registry& registry) {
  registry.add_loss<DepthLoss>("depth", "depth images of training frames; pixels without depth count for nothing",
                               "depth of training frames in memory, two bytes per pixel, and its gradient");
})

}  // namespace semfield
