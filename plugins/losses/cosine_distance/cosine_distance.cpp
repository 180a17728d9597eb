#include "losses/cosine_distance/cosine_distance.h"

#include "plugin/module.h"

namespace semfield {

void describe(ParamVisitor& visit, CosineDistanceParams& p) {
  SEMFIELD_PARAM(visit, p, channel, "the channel of the dataset and of the head that makes it");
}

LossTraits CosineDistance::traits() const {
  LossTraits traits;
  traits.targets = {params.channel};
  traits.heads = {params.channel};
  traits.moves = {params.channel};
  return traits;
}

namespace {

template <class Real, class Other>
double product(View<const Real> a, View<const Other> b, std::int64_t row) {
  double sum = 0;
  for (std::int32_t c = 0; c < a.cols; ++c) sum += static_cast<double>(a(row, c)) * static_cast<double>(b(row, c));
  return sum;
}

}  // namespace

std::int64_t CosineDistance::counted_rays(const RayTargets& batch, std::int64_t) const {
  const View<const float> target = batch.more[params.channel];
  std::int64_t counted = 0;
  for (std::int64_t r = 0; r < target.rows; ++r) counted += product(target, target, r) > 0 ? 1 : 0;
  return counted;
}

template <class Real>
double CosineDistance::sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
                           const RayGradients<Real>& gradients) const {
  const View<const float> target = targets.more[params.channel];
  const View<const Real> made = values.heads[params.channel];
  const View<Real> d_made = gradients.heads[params.channel];
  if (target.empty()) return 0;
  double sum = 0;
  for (std::int64_t r = 0; r < made.rows; ++r) {
    const double target_square = product(target, target, r);
    if (!(target_square > 0)) continue;
    const RowAngle angle = row_angle(target_square, product(made, made, r), product(made, target, r));
    sum += 1 - angle.cosine;
    for (std::int32_t c = 0; c < made.cols; ++c)
      d_made(r, c) -=
          static_cast<Real>(angle.slope(scale, static_cast<double>(target(r, c)), static_cast<double>(made(r, c))));
  }
  return sum;
}

template double CosineDistance::sum<float>(const RayTargets&, const RayValues<float>&, double,
                                           const RayGradients<float>&) const;
template double CosineDistance::sum<double>(const RayTargets&, const RayValues<double>&, double,
                                            const RayGradients<double>&) const;

SEMFIELD_PLUGIN_MODULE(cosine_distance, "1.0", [](Registry& registry) {
  registry.add_loss<CosineDistance>("cosine_distance",
                                    "The angle between a head's channel and the dataset's channel of its name.",
                                    "a product per ray and column");
})

}  // namespace semfield
