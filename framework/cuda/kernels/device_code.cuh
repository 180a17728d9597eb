// Small pieces that kernels share: faults, random addresses of the running step, sums over a warp.
#pragma once

#include <cuda_runtime.h>

#include "cuda/launch.h"

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

}  // namespace semfield::cuda
