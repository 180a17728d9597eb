#include "losses/silhouette/silhouette.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor&, SilhouetteParams&) {}

LossTraits SilhouetteLoss::traits() const {
  LossTraits traits;
  traits.targets = {channel::alpha};
  traits.moves = {channel::weight};
  return traits;
}

std::int64_t SilhouetteLoss::counted_rays(const RayTargets& batch, std::int64_t) const {
  std::int64_t known = 0;
  const View<const float> alpha = batch.more[channel::alpha];
  for (std::int64_t r = 0; r < alpha.rows; ++r) known += alpha(r, 0) >= 0 ? 1 : 0;
  return known;
}

template <class Real>
double SilhouetteLoss::sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
                           const RayGradients<Real>& gradients) const {
  double sum = 0;
  const View<const float> alpha = targets.more[channel::alpha];
  for (std::int64_t r = 0; r < alpha.rows; ++r) {
    const std::int32_t begin = values.first(r, 0), end = values.first(r + 1, 0);
    if (!(alpha(r, 0) >= 0) || begin == end) continue;
    const LossValue share =
        silhouette_share(static_cast<double>(values.opacity(r, 0)), static_cast<double>(alpha(r, 0)));
    sum += share.value;
    for (std::int32_t m = begin; m < end; ++m) gradients.weight(m, 0) += static_cast<Real>(scale * share.slope);
  }
  return sum;
}

template double SilhouetteLoss::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                           const RayGradients<float>&) const;
template double SilhouetteLoss::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                            const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(silhouette, "1.0", [](Registry& registry) {
  registry.add_loss<SilhouetteLoss>(
      "silhouette", "A ray is as opaque as its pixel, of images with alpha: no fog before a background.",
      "alpha of training frames in memory, a byte per pixel, and its gradient");
})

}  // namespace semfield
