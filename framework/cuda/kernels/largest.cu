// Looks for the largest size of a number: 4 B per number read.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/largest.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kRowsOfBlock = 32;

// A thread kCols columns of every n-th row: at most kThreads such pieces a row, with kCols of 4 on 16-byte boundaries.
template <int kCols>
__global__ void __launch_bounds__(kThreads)
    largest_kernel(View<const float> values, const std::int32_t* live_rows, std::uint32_t* largest) {
  struct alignas(sizeof(float) * kCols) Piece {
    float v[kCols];
  };
  const int pieces = values.cols / kCols, rows_at_once = kThreads / pieces;
  const int piece = static_cast<int>(threadIdx.x) % pieces, first = static_cast<int>(threadIdx.x) / pieces;
  const std::int64_t rows = first < rows_at_once ? live_count(live_rows, values.rows) : 0;
  const std::int64_t step = static_cast<std::int64_t>(gridDim.x) * rows_at_once;
  std::uint32_t most = 0;
#pragma unroll 4
  for (std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * rows_at_once + first; row < rows; row += step) {
    const Piece d = reinterpret_cast<const Piece*>(values.row(row))[piece];
#pragma unroll
    for (int c = 0; c < kCols; ++c) most = max(most, __float_as_uint(fabsf(d.v[c])));
  }
  most = __reduce_max_sync(kFullMask, most);
  if (threadIdx.x % kWarp == 0 && most != 0) atomicMax(largest, most);
}

}  // namespace

void find_largest(View<const float> values, std::uint32_t* largest) {
  if (values.size() == 0) return;
  const bool by_four = values.cols % 4 == 0 && values.row_stride % 4 == 0 &&
                       reinterpret_cast<std::uintptr_t>(values.data) % sizeof(float4) == 0;
  SEMFIELD_CHECK(values.cols / (by_four ? 4 : 1) <= kThreads, "a block looks at whole rows");
  const auto kernel = by_four ? largest_kernel<4> : largest_kernel<1>;
  const unsigned most = 8U * static_cast<unsigned>(multiprocessors());
  kernel<<<std::min(blocks_of(values.rows, kRowsOfBlock), most), kThreads, 0, launch().stream>>>(
      values, launch().live_rows, largest);
  check_launch("largest number");
}

}  // namespace semfield::cuda
