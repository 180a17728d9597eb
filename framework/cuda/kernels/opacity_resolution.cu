// Whether steps along rays were short enough.
#include <climits>

#include "cuda/kernels/ray_scan.cuh"
#include "cuda/kernels/rendering.h"
#include "model/opacity_resolution.h"

namespace semfield::cuda {

namespace {

// Both seen: the larger weight is first; of equal ones the earlier sample.
__device__ OpacitySums merged(const OpacitySums& a, const OpacitySums& b) {
  OpacitySums sum;
  sum.opacity = a.opacity + b.opacity;
  const bool take_b = b.first > a.first || (b.first == a.first && b.at < a.at);
  sum.first = take_b ? b.first : a.first;
  sum.at = take_b ? b.at : a.at;
  const double other = take_b ? a.first : b.first, own = take_b ? b.second : a.second;
  sum.second = other > own ? other : own;
  return sum;
}

// A warp per ray, 4 B per sample; fixed tree of sums.
__global__ void __launch_bounds__(kRayThreads)
    resolution_kernel(Samples<float> samples, View<const float> weight, FarMode far, double footprint_per_m,
                      View<OpacityResolution> result) {
  const WarpRay at(samples.first);
  if (!at.exists()) return;
  const std::int32_t end = at.end - (far == FarMode::background ? 1 : 0);
  OpacitySums sums;
  sums.at = INT_MAX;
  for (std::int32_t k = at.begin + at.lane; k < end; k += kWarp) {
    OpacitySums one;
    one.opacity = one.first = static_cast<double>(weight(k, 0));
    one.at = k;
    sums = merged(sums, one);
  }
  for (int offset = kWarp / 2; offset > 0; offset /= 2) {
    OpacitySums other;
    other.opacity = __shfl_xor_sync(kFullMask, sums.opacity, offset);
    other.first = __shfl_xor_sync(kFullMask, sums.first, offset);
    other.second = __shfl_xor_sync(kFullMask, sums.second, offset);
    other.at = __shfl_xor_sync(kFullMask, sums.at, offset);
    sums = merged(sums, other);
  }
  if (at.lane != 0) return;
  OpacityResolution found = OpacityResolution::clear;
  if (sums.opacity > 0) {
    found = resolution_of(sums, static_cast<double>(samples.t(sums.at, 0)),
                          static_cast<double>(samples.delta(sums.at, 0)), footprint_per_m);
  }
  result(at.ray, 0) = found;
}

}  // namespace

void opacity_resolutions(const Samples<float>& samples, View<const float> weight, FarMode far, double footprint_per_m,
                         View<OpacityResolution> result) {
  const std::int64_t rays = samples.first.rows - 1;
  if (rays == 0) return;
  resolution_kernel<<<ray_blocks(rays), kRayThreads, 0, launch().stream>>>(samples, weight, far, footprint_per_m,
                                                                           result);
  check_launch("opacity resolution");
}

}  // namespace semfield::cuda
