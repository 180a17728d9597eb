// What kernels share: launches, faults, random addresses of the running step, sums over a warp, a warp per ray; what
// samplers and loss terms are made of.
#pragma once

#include <cuda_runtime.h>

#include <climits>
#include <limits>

#include "cuda/launch.h"
#include "plugin/loss.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield::cuda {

/// Queues `kernel` on launch().stream; nothing where there is no block. Throws for a kernel that could not start.
template <class... Parameters, class... Arguments>
void queue(const char* what, dim3 blocks, dim3 threads, void (*kernel)(Parameters...), const Arguments&... arguments) {
  if (blocks.x == 0 || blocks.y == 0) return;
  kernel<<<blocks, threads, 0, launch().stream>>>(arguments...);
  check_launch(what);
}

/// Of a grid of one dimension.
__device__ inline std::int64_t thread_index() {
  return static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
}
__device__ inline std::int64_t grid_threads() { return static_cast<std::int64_t>(gridDim.x) * blockDim.x; }

inline constexpr int kWarp = 32;
inline constexpr unsigned kFullMask = 0xFFFFFFFFu;

/// Notes a fault; the smallest key stays, so the stage that comes first and its first row are told.
__device__ inline void note_fault(FaultKey* cell, Stage stage, std::int64_t row) {
  if (cell == nullptr) return;
  atomicMin(cell, (static_cast<FaultKey>(stage) << kFaultRowBits) | static_cast<FaultKey>(row));
}

/// The address at the running step.
__device__ inline RandomAddress at_step(RandomAddress address, const StepCell* cell) {
  if (cell != nullptr) address.step = cell->step;
  return address;
}

/// Rows in use of `rows`.
__device__ inline std::int64_t live_count(const std::int32_t* live_rows, std::int64_t rows) {
  return live_rows == nullptr || *live_rows > rows ? rows : *live_rows;
}

/// Sum over the warp in a fixed tree; every lane gets it.
template <class T>
__device__ inline T warp_sum(T value) {
  for (int offset = kWarp / 2; offset > 0; offset /= 2) value += __shfl_xor_sync(kFullMask, value, offset);
  return value;
}

/// Sum over a block of kThreads in a fixed tree; thread 0 gets it. All threads call it.
template <int kThreads, class T>
__device__ inline T block_sum(T value) {
  __shared__ T of_warp[kThreads / kWarp];
  value = warp_sum(value);
  __syncthreads();  // an earlier sum may still be read
  if (threadIdx.x % kWarp == 0) of_warp[threadIdx.x / kWarp] = value;
  __syncthreads();
  T sum = 0;
  for (int w = 0; threadIdx.x == 0 && w < kThreads / kWarp; ++w) sum += of_warp[w];
  return sum;
}

/// Zeroes rows [begin, rows) of a view, by `threads` threads of which this is number `thread`.
__device__ inline void clear_rows(View<float> view, std::int64_t begin, std::int64_t thread, std::int64_t threads) {
  const std::int64_t end = view.rows * view.cols;
  for (std::int64_t i = begin * view.cols + thread; i < end; i += threads) {
    if (view.contiguous()) {
      view.data[i] = 0;
    } else {
      view(i / view.cols, static_cast<std::int32_t>(i % view.cols)) = 0;
    }
  }
}

// Sums along a ray, a warp per ray: lane j of a tile of 32 samples holds sample j.

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
    clear_rows(view, first(rays, 0), thread_index(), grid_threads());
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

// Softmax of one row by a warp: lane j holds classes j, j + 32, ...

/// The largest value of a row and where it stands first; every lane gets them.
struct RowTop {
  float largest;
  std::int32_t argmax;
  bool finite;  ///< all values of the row are
};

__device__ inline RowTop top_of_row(const float* row, std::int32_t cols, int lane) {
  RowTop top{-INFINITY, INT_MAX, true};
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    const float value = row[c];
    top.finite = top.finite && isfinite(value);
    if (value > top.largest) top = {value, c, top.finite};
  }
  for (int offset = kWarp / 2; offset > 0; offset /= 2) {
    const float largest = __shfl_xor_sync(kFullMask, top.largest, offset);
    const std::int32_t argmax = __shfl_xor_sync(kFullMask, top.argmax, offset);
    if (largest > top.largest || (largest == top.largest && argmax < top.argmax)) {
      top.largest = largest;
      top.argmax = argmax;
    }
  }
  top.finite = __all_sync(kFullMask, top.finite) != 0;
  if (top.argmax == INT_MAX) top.argmax = 0;  // nothing above -inf: not finite, or no column
  return top;
}

/// e^(s_c - largest) in Real.
template <class Real>
__device__ inline Real exp_below(const float* row, std::int32_t c, float largest) {
  return exp(static_cast<Real>(row[c]) - static_cast<Real>(largest));
}

/// Sum of e^(s_c - largest) over all classes but the largest's, in float64 in a fixed tree; every lane gets it. Keeping
/// that one apart leaves log1p(rest) and -rest / (1 + rest) exact for a row that is almost certain.
template <class Real>
__device__ inline double rest_of_row(const float* row, std::int32_t cols, const RowTop& top, int lane) {
  double rest = 0;
  for (std::int32_t c = lane; c < cols; c += kWarp) {
    if (c != top.argmax) rest += static_cast<double>(exp_below<Real>(row, c, top.largest));
  }
  return warp_sum(rest);
}

// Loss terms: a warp per ray, and the ray's loss as the sum over its lanes.

/// `body(at, scale)` is called by all lanes of a warp; the lanes' results add up to the ray's loss, in a fixed tree.
template <class Body>
__global__ void __launch_bounds__(kRayThreads)
    loss_of_rays(View<const std::int32_t> first, Body body, const double* scale, double* of_ray) {
  const WarpRay at(first);
  if (!at.exists()) return;
  const double loss = warp_sum(static_cast<double>(body(at, *scale)));
  if (at.lane == 0) of_ray[at.ray] = loss;
}

template <class Body>
void launch_over_rays(const LossCall& call, const Body& body, const char* name) {
  const std::int64_t rays = call.values.first.rows - 1;
  queue(name, blocks_of(rays, kRaysPerBlock), kRayThreads, loss_of_rays<Body>, call.values.first, body, call.scale,
        call.of_ray);
}

// Samplers: limits of rays, places of ragged output, the unused rows behind it.

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
  for (std::int64_t row = *out.first.row(rays) + thread_index(); row < out.count; row += grid_threads()) {
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
  queue("offsets of samples", blocks_of(rays, kOffsetThreads), kOffsetThreads, offsets_kernel<CountOf>, count_of, rays,
        static_cast<std::int32_t>(room), first, launch().fault);
}

}  // namespace semfield::cuda
