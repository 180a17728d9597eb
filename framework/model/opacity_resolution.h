// Whether the steps along a ray were short enough for what it met.
#pragma once

#include <cstdint>

#include "model/compositor.h"

namespace semfield {

enum class OpacityResolution : std::uint8_t { clear, resolved, under_resolved };

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
