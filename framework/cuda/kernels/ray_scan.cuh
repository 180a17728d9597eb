// Sums along a ray, a warp per ray: lane j of a tile of 32 samples holds sample j.
#pragma once

#include "cuda/kernels/device_code.cuh"
#include "plugin/sampler.h"

namespace semfield::cuda {

inline constexpr int kRaysPerBlock = 4;
inline constexpr int kRayThreads = kRaysPerBlock * kWarp;

/// Blocks of kRayThreads for `rays`; at least one, which clears rows that no ray owns.
inline unsigned ray_blocks(std::int64_t rays) { return rays == 0 ? 1 : blocks_of(rays, kRaysPerBlock); }

/// The warp's ray, its samples and the lane.
struct WarpRay {
  std::int64_t ray, rays;
  std::int32_t begin = 0, end = 0;
  int lane;
  __device__ explicit WarpRay(View<const std::int32_t> first)
      : ray(static_cast<std::int64_t>(blockIdx.x) * kRaysPerBlock + threadIdx.x / kWarp),
        rays(first.rows - 1),
        lane(static_cast<int>(threadIdx.x % kWarp)) {
    if (!exists()) return;
    begin = first(ray, 0);
    end = first(ray + 1, 0);
  }
  /// False for all lanes of a warp behind the last ray.
  __device__ bool exists() const { return ray < rays; }
  /// clear_rows by all threads of the grid.
  __device__ void clear_behind(View<const std::int32_t> first, View<float> view) const {
    clear_rows(view, first(rays, 0), static_cast<std::int64_t>(blockIdx.x) * kRayThreads + threadIdx.x,
               static_cast<std::int64_t>(gridDim.x) * kRayThreads);
  }
};

/// Sum over lanes 0..own, in a fixed tree.
__device__ inline double warp_prefix(double value, int lane) {
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const double before = __shfl_up_sync(kFullMask, value, offset);
    if (lane >= offset) value += before;
  }
  return value;
}

/// x -> keep x + gain.
struct Affine {
  double keep = 1, gain = 0;
};

/// The maps of lanes own..31 as one: that of lane 31 is applied first.
__device__ inline Affine warp_suffix(Affine map, int lane) {
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const double keep = __shfl_down_sync(kFullMask, map.keep, offset);
    const double gain = __shfl_down_sync(kFullMask, map.gain, offset);
    if (lane + offset < kWarp) {
      map.gain += map.keep * gain;
      map.keep *= keep;
    }
  }
  return map;
}

}  // namespace semfield::cuda
