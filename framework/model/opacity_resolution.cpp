#include "model/opacity_resolution.h"

namespace semfield {

template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m) {
  constexpr double kMet = 0.5, kMostOfIt = 0.9;
  const std::int32_t begin = samples.first(ray, 0);
  const std::int32_t end = samples.first(ray + 1, 0) - (far == FarMode::background ? 1 : 0);
  double opacity = 0, first = 0, second = 0;
  std::int32_t at = begin;
  for (std::int32_t k = begin; k < end; ++k) {
    const double w = static_cast<double>(weight(k, 0));
    opacity += w;
    if (w > first) {
      second = first;
      first = w;
      at = k;
    } else if (w > second) {
      second = w;
    }
  }
  if (opacity < kMet) return OpacityResolution::clear;
  const double pixel_m = footprint_per_m * static_cast<double>(samples.t(at, 0));
  const bool coarse = first + second >= kMostOfIt * opacity && static_cast<double>(samples.delta(at, 0)) > pixel_m;
  return coarse ? OpacityResolution::under_resolved : OpacityResolution::resolved;
}

template OpacityResolution opacity_resolution<float>(const Samples<float>&, View<const float>, FarMode, std::int64_t,
                                                     double);
template OpacityResolution opacity_resolution<double>(const Samples<double>&, View<const double>, FarMode, std::int64_t,
                                                      double);

}  // namespace semfield
