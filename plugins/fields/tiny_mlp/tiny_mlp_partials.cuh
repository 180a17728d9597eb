// Sums that blocks left in device memory, added in a fixed order.
#pragma once

#include "cuda/kernels/device_code.cuh"

namespace semfield::cuda::tiny {

inline constexpr int kSumColumns = 32, kSumSegments = 8;

/// Sum of partial[r size + element] over r < ranges, in the first warp of a block of (32, 8) threads; element is
/// 32 blockIdx.x + threadIdx.x. A warp reads 32 neighbouring elements, eight warps share the ranges: 4 ranges bytes an
/// element. To be called by all threads.
__device__ inline float sum_of_partials(const float* __restrict__ partial, int ranges, std::int64_t size,
                                        std::int64_t element) {
  __shared__ float segment_sum[kSumSegments][kSumColumns];
  const int each = (ranges + kSumSegments - 1) / kSumSegments;
  const int begin = static_cast<int>(threadIdx.y) * each;
  const int end = begin + each < ranges ? begin + each : ranges;
  float sum = 0;
  if (element < size) {
#pragma unroll 8
    for (int r = begin; r < end; ++r) sum += partial[r * size + element];
  }
  segment_sum[threadIdx.y][threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.y == 0) {
    for (int s = 1; s < kSumSegments; ++s) sum += segment_sum[s][threadIdx.x];
  }
  return sum;
}

}  // namespace semfield::cuda::tiny
