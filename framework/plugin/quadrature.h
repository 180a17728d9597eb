// What samplers share: the quadrature rules of the rendering integral, and which part of a ray is sampled.
#pragma once

#include <cmath>
#include <cstdint>
#include <string>

#include "config/params.h"
#include "core/error.h"
#include "core/view.h"

namespace semfield {

/// Where a sample stands in the interval it speaks for. Every rule is exact for the frozen field on its intervals; the
/// error after N samples of a smooth field is of the order given.
///   paper           jittered points, each at the near end of its interval: delta_k = t_{k+1} - t_k, the last one ends
///                   at far; [near, t_1] is skipped. Order 1 [Mildenhall20]. Without training the jitter is its mean,
///                   1/2: the midpoint rule but for the last interval, which is half as long.
///   midpoint        fixed points amid their intervals, never jittered. Order 2.
///   stratified_bin  jittered points, each speaking for the whole of its bin. Order 1.5, unbiased in optical depth;
///                   without training the same as midpoint.
enum class Quadrature : std::uint8_t { paper, midpoint, stratified_bin };

SEMFIELD_CHOICES(Quadrature, "paper", "midpoint", "stratified_bin");

/// Throws Error(data): "ray 7 runs from 0.1 to inf m; samples need finite limits".
[[noreturn]] void bad_ray_limits(std::int64_t ray, double near_m, double far_m);

/// The part of a ray to be sampled: false for an empty ray (near >= far). Throws Error(data) for limits that are not
/// finite.
SEMFIELD_HD inline bool ray_span(View<const double> near_far, std::int64_t ray, std::int64_t first_ray, double& near_m,
                                 double& far_m) {
  near_m = near_far(ray, 0);
  far_m = near_far(ray, 1);
  if (std::isfinite(near_m) && std::isfinite(far_m)) return near_m < far_m;
  bad_ray_limits(first_ray + ray, near_m, far_m);
}

/// t as Real, not rounded out of [near, far].
template <class Real>
SEMFIELD_HD inline Real round_inside(double t, double near_m, double far_m) {
  Real rounded = static_cast<Real>(t);
  // The second argument as Real: with a double the neighbour would be a double, which rounds back to where it was.
  if (static_cast<double>(rounded) > far_m) rounded = std::nextafter(rounded, static_cast<Real>(-HUGE_VAL));
  if (static_cast<double>(rounded) < near_m) rounded = std::nextafter(rounded, static_cast<Real>(HUGE_VAL));
  return rounded;
}

/// Interval lengths of `count` ascending points in [near, far]. paper: to the next point. Else the cells of the points,
/// whose borders lie midway between neighbours and which together fill [near, far]: the trapezoid rule, order 2.
SEMFIELD_HD inline double interval_of(Quadrature rule, const double* t, std::int64_t count, std::int64_t k,
                                      double near_m, double far_m) {
  if (rule == Quadrature::paper) return (k + 1 < count ? t[k + 1] : far_m) - t[k];
  const double begin = k == 0 ? near_m : 0.5 * (t[k - 1] + t[k]);
  const double end = k + 1 == count ? far_m : 0.5 * (t[k] + t[k + 1]);
  return end - begin;
}

}  // namespace semfield
