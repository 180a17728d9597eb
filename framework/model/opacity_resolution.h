// Whether the steps along a ray were short enough for what it met.
#pragma once

#include <cstdint>

#include "model/compositor.h"

namespace semfield {

enum class OpacityResolution : std::uint8_t { clear, resolved, under_resolved };

/// What the weights of a ray say: their sum, the two largest, and the first sample that has the largest.
struct OpacitySums {
  double opacity = 0, first = 0, second = 0;
  std::int32_t at = 0;
};
/// The rule of opacity_resolution; t and delta are those of sample `at`.
SEMFIELD_HD inline OpacityResolution resolution_of(const OpacitySums& sums, double t, double delta,
                                                   double footprint_per_m) {
  constexpr double kMet = 0.5, kMostOfIt = 0.9;
  if (sums.opacity < kMet) return OpacityResolution::clear;
  const bool coarse = sums.first + sums.second >= kMostOfIt * sums.opacity && delta > footprint_per_m * t;
  return coarse ? OpacityResolution::under_resolved : OpacityResolution::resolved;
}

/// With O the opacity of a ray (without the last sample's weight under FarMode::background, which is no density), a and
/// b its two largest weights, and delta_a, t_a the interval and distance of a:
///   clear            O < 1/2: the ray met little;
///   under_resolved   a + b >= 0.9 O and delta_a > footprint_per_m t_a: at most two steps, longer than a pixel is wide
///   at
///                    that distance, gave the opacity. The surface lies anywhere within them, and matter as thin as the
///                    pixel grid could show is seen with the chance of width / delta alone;
///   resolved         else.
/// `weight` [M, 1] of `samples`.
template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m);

}  // namespace semfield
