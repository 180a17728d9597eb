// Small pieces that kernels share: faults, random addresses of the running step, sums over a warp.
#pragma once

#include <cuda_runtime.h>

#include <climits>

#include "cuda/launch.h"
#include "plugin/sampler.h"

namespace semfield::cuda {

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

}  // namespace semfield::cuda
