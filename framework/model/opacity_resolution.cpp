#include "model/opacity_resolution.h"

namespace semfield {

template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m) {
  OpacitySums sums;
  sums.at = samples.first(ray, 0);
  const std::int32_t end = samples.first(ray + 1, 0) - (far == FarMode::background ? 1 : 0);
  for (std::int32_t k = sums.at; k < end; ++k) {
    const double w = static_cast<double>(weight(k, 0));
    sums.opacity += w;
    if (w > sums.first) {
      sums.second = sums.first;
      sums.first = w;
      sums.at = k;
    } else if (w > sums.second) {
      sums.second = w;
    }
  }
  if (sums.opacity == 0) return OpacityResolution::clear;  // a ray without samples has no sample `at`
  return resolution_of(sums, static_cast<double>(samples.t(sums.at, 0)), static_cast<double>(samples.delta(sums.at, 0)),
                       footprint_per_m);
}

template OpacityResolution opacity_resolution<float>(const Samples<float>&, View<const float>, FarMode, std::int64_t,
                                                     double);
template OpacityResolution opacity_resolution<double>(const Samples<double>&, View<const double>, FarMode, std::int64_t,
                                                      double);

}  // namespace semfield
