// What samplers share on the device: limits of rays, places of ragged output, the unused rows behind it.
#pragma once

#include <limits>

#include "cuda/kernels/device_code.cuh"
#include "cuda/memory.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield::cuda {

inline constexpr int kOffsetThreads = 1024;

/// As ray_span, but limits that are not finite are a fault of Stage::rays with the call's ray, and an empty ray.
__device__ inline bool span_of_ray(View<const double> near_far, std::int64_t ray, FaultKey* fault, double& near_m,
                                   double& far_m) {
  near_m = near_far(ray, 0);
  far_m = near_far(ray, 1);
  if (isfinite(near_m) && isfinite(far_m)) return near_m < far_m;
  note_fault(fault, Stage::rays, ray);
  return false;
}

/// With launch().check_at_once: throws for a fault that span_of_ray noted.
inline void throw_bad_limits(View<const double> near_far, std::int64_t first_ray) {
  const std::int64_t ray = first_fault_row(Stage::rays);
  if (ray < 0) return;
  double limits[2];
  download<double>(near_far.row(ray), limits);
  synchronize();
  bad_ray_limits(first_ray + ray, limits[0], limits[1]);
}

/// Fills rows [first[R], out.count), shared out to all threads of the grid.
__device__ inline void fill_unused_rows(const Samples<float>& out, std::int64_t rays) {
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const std::int64_t threads = static_cast<std::int64_t>(gridDim.x) * blockDim.x;
  for (std::int64_t row = *out.first.row(rays) + thread; row < out.count; row += threads) {
    *out.t.row(row) = 0;
    *out.delta.row(row) = 0;
    *out.ray_of_sample.row(row) = static_cast<std::int32_t>(rays - 1);
  }
}

// first[r] = samples of the rays before r. One thread per ray; each block adds up the counts of all rays before its own
// 1,024 itself, so that blocks wait for nobody: R / 1,024 loads a thread at most. Integers: the order does not matter.
template <class CountOf>
__global__ void __launch_bounds__(kOffsetThreads)
    offsets_kernel(CountOf count_of, std::int64_t rays, std::int32_t room, View<std::int32_t> first, FaultKey* fault) {
  __shared__ std::int32_t before_of_warp[kWarp], own_of_warp[kWarp];
  const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const std::int64_t tile = static_cast<std::int64_t>(blockIdx.x) * kOffsetThreads;
  std::int32_t before = 0;
#pragma unroll 4
  for (std::int64_t ray = threadIdx.x; ray < tile; ray += kOffsetThreads) before += count_of(ray, nullptr);
  before = warp_sum(before);
  const std::int64_t ray = tile + threadIdx.x;
  std::int32_t up_to = ray < rays ? count_of(ray, fault) : 0;
  for (int offset = 1; offset < kWarp; offset *= 2) {
    const std::int32_t lower = __shfl_up_sync(kFullMask, up_to, offset);
    if (lane >= offset) up_to += lower;
  }
  if (lane == 0) before_of_warp[warp] = before;
  if (lane == kWarp - 1) own_of_warp[warp] = up_to;
  __syncthreads();
  const std::int32_t lower_warps = lane < warp ? own_of_warp[lane] : 0;
  const std::int32_t base = warp_sum(before_of_warp[lane] + lower_warps);
  if (ray < rays) *first.row(ray + 1) = min(base + up_to, room);
  if (ray == rays - 1 && base + up_to > room) note_fault(fault, Stage::room, ray);
  if (ray == 0) *first.row(0) = 0;
}

/// Fills `first` [R + 1] from `std::int32_t count_of(ray, fault)`, device code; what it notes goes to `fault`, which is
/// null when a ray is looked at a second time. At least one ray. More samples than `room` are a fault of Stage::room,
/// and none of them is in `first`.
template <class CountOf>
void queue_offsets(const CountOf& count_of, std::int64_t rays, View<std::int32_t> first,
                   std::int64_t room = std::numeric_limits<std::int32_t>::max()) {
  offsets_kernel<<<blocks_of(rays, kOffsetThreads), kOffsetThreads, 0, launch().stream>>>(
      count_of, rays, static_cast<std::int32_t>(room), first, launch().fault);
  check_launch("offsets of samples");
}

}  // namespace semfield::cuda
