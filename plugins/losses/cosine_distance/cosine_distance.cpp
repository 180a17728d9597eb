#include "losses/cosine_distance/cosine_distance.h"

#include <cmath>

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

template <class Real>
double squared_norm(const Real* row, std::int32_t n) {
  double sum = 0;
  for (std::int32_t c = 0; c < n; ++c) sum += static_cast<double>(row[c]) * static_cast<double>(row[c]);
  return sum;
}

// Added to the squared norm of what the head makes: its row is almost zero where a ray meets almost nothing, and there
// the angle would have a slope without bounds. It bounds the slope by 100, and the loss of a row of length 1 by 1e-4.
constexpr double kLeastSquare = 1e-4;

}  // namespace

std::int64_t CosineDistance::counted_rays(const RayTargets& batch, std::int64_t) const {
  const View<const float> target = batch.more[params.channel];
  std::int64_t counted = 0;
  for (std::int64_t r = 0; r < target.rows; ++r) counted += squared_norm(target.row(r), target.cols) > 0 ? 1 : 0;
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
    const double of_target = std::sqrt(squared_norm(target.row(r), target.cols));
    if (!(of_target > 0)) continue;
    const double of_made = std::sqrt(squared_norm(made.row(r), made.cols) + kLeastSquare);
    double dot = 0;
    for (std::int32_t c = 0; c < made.cols; ++c)
      dot += static_cast<double>(made(r, c)) * static_cast<double>(target(r, c));
    const double cosine = dot / (of_made * of_target);
    sum += 1 - cosine;
    for (std::int32_t c = 0; c < made.cols; ++c) {
      const double slope =
          static_cast<double>(target(r, c)) / of_target - cosine * static_cast<double>(made(r, c)) / of_made;
      d_made(r, c) -= static_cast<Real>(scale * slope / of_made);
    }
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
