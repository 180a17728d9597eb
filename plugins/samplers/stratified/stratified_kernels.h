// Parameters and kernel table of the stratified sampler.
#pragma once

#include <cstdint>

#include "core/rng.h"
#include "core/view.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield {

class KernelTables;

/// What the bins of a ray have in common.
///   linear     their length in metres;
///   disparity  their length in 1 / t: fine near the camera, coarse far away.
enum class SampleSpacing : std::uint8_t { linear, disparity };
SEMFIELD_CHOICES(SampleSpacing, "linear", "disparity");

struct StratifiedParams {
  std::int64_t samples = 64;  ///< N, bins a ray
  Quadrature quadrature = Quadrature::paper;
  SampleSpacing spacing = SampleSpacing::linear;
};

struct StratifiedArgs : StratifiedParams {
  bool jitter = false;  ///< false: the middle of each bin
  RandomAddress random;
  std::int64_t first_ray = 0;
};

template <class Real>
struct StratifiedKernels {
  /// Fills out.t, delta, ray_of_sample, first and count from near_far [R, 2].
  void (*sample)(const StratifiedArgs& args, View<const double> near_far, Samples<Real>& out) = nullptr;
};

void stratified_kernels(KernelTables& tables);

// Formulas of the stratified sampler, for host and device.

/// t_k = near + (far - near) (k + u) / N, k = 0..N-1, u in [0, 1) [Mildenhall20 Eq. 2].
SEMFIELD_HD inline double stratum_point(double near_m, double far_m, std::int64_t k, double u, std::int64_t n) {
  return near_m + (far_m - near_m) * ((static_cast<double>(k) + u) / static_cast<double>(n));
}

/// The same in disparity: 1/t_k = 1/near + (1/far - 1/near) (k + u) / N. The eye itself has no disparity, so a near
/// below far / 1000 counts as far / 1000 there, and the first bin begins at near.
SEMFIELD_HD inline double disparity_point(double near_m, double far_m, std::int64_t k, double u, std::int64_t n) {
  const double s = (static_cast<double>(k) + u) / static_cast<double>(n), least = 1e-3 * far_m;
  if (s <= 0) return near_m;
  const double from = 1 / (near_m < least ? least : near_m);
  return 1 / (from + (1 / far_m - from) * s);
}

/// Point u of bin k.
SEMFIELD_HD inline double point_of_bin(SampleSpacing spacing, double near_m, double far_m, std::int64_t k, double u,
                                       std::int64_t n) {
  return spacing == SampleSpacing::disparity ? disparity_point(near_m, far_m, k, u, n)
                                             : stratum_point(near_m, far_m, k, u, n);
}

/// Length of bin k.
SEMFIELD_HD inline double length_of_bin(SampleSpacing spacing, double near_m, double far_m, std::int64_t k,
                                        std::int64_t n) {
  if (spacing == SampleSpacing::linear) return (far_m - near_m) / static_cast<double>(n);
  const double end = k + 1 == n ? far_m : disparity_point(near_m, far_m, k + 1, 0, n);
  return end - disparity_point(near_m, far_m, k, 0, n);
}

}  // namespace semfield
