// Loss `silhouette`: what transparent images say of where the subject is.
#pragma once

#include "core/view.h"
#include "plugin/loss.h"

namespace semfield {

struct SilhouetteParams : LossRule {
  SilhouetteParams() { weight = 0.1; }
};
void describe(ParamVisitor& visit, SilhouetteParams& p);

// The formula of the silhouette loss, for CPU and GPU.

/// (O - a)^2 and its slope for every weight of the ray. Before a background b that is drawn anew for each ray and
/// channel, uniform in [0, 1], with the same b behind the photograph, the expected squared error of colour is that
/// before grey plus (O - a)^2 / 12; random backgrounds are the habit of [Mueller22].
SEMFIELD_HD inline LossValue silhouette_share(double opacity, double alpha) {
  const double error = opacity - alpha;
  return {error * error, 2 * error};
}

/// The squared difference between a ray's opacity and its pixel's alpha; rays without a known alpha do not count.
class SilhouetteLoss final : public LossOf<SilhouetteLoss, SilhouetteParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override { return {.targets = {channel::alpha}, .moves = {channel::weight}}; }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t) const override {
    std::int64_t known = 0;
    const View<const float> alpha = batch.more[channel::alpha];
    for (std::int64_t r = 0; r < alpha.rows; ++r) known += alpha(r, 0) >= 0 ? 1 : 0;
    return known;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
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
};

}  // namespace semfield
