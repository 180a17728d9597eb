// A bias that enters each row of a layer by a share of its own: products of one row or one column, which take as long
// as moving y does.
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/layers.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / kWarp;
constexpr int kWarpRows = 4;
constexpr int kBlockRows = kWarps * kWarpRows;
constexpr int kLaneColumns = 8;  // at once
constexpr int kColumns = kWarp * kLaneColumns;

// A warp per row; 4 C B written per row.
__global__ void __launch_bounds__(kThreads)
    forward_kernel(View<const float> share, View<const float> bias, View<float> y) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (row >= y.rows) return;
  const float factor = share(row, 0);
  float* const to = y.row(row);
  for (auto c = static_cast<std::int32_t>(threadIdx.x % kWarp); c < y.cols; c += kWarp) to[c] = factor * bias(0, c);
}

// A warp 4 rows, a block 32; a lane every 32nd column, 8 of them at once. dy is read once, 4 C B per row. partial
// [blocks, C]: the block's share of d_bias, rows in order within a warp, then the warps. d_share: a lane's columns in
// order, then the lanes in a fixed tree. Behind the last row and column the last is read, so that no load waits for a
// branch, and counts 0.
__global__ void __launch_bounds__(kThreads)
    backward_kernel(View<const float> share, View<const float> bias, View<const float> dy, View<float> d_share,
                    View<float> partial) {
  __shared__ float of_warp[kWarps][kColumns];
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kBlockRows + warp * kWarpRows;
  const float* row[kWarpRows];
  float factor[kWarpRows], dot[kWarpRows] = {};
#pragma unroll
  for (int i = 0; i < kWarpRows; ++i) {
    const std::int64_t r = min(first + i, dy.rows - 1);
    row[i] = dy.row(r);
    factor[i] = r == first + i ? share(r, 0) : 0.0F;
  }
  for (std::int32_t base = 0; base < dy.cols; base += kColumns) {
    float d[kWarpRows][kLaneColumns], of_column[kLaneColumns];
#pragma unroll
    for (int j = 0; j < kLaneColumns; ++j) {
      const std::int32_t wanted = base + lane + j * kWarp, c = min(wanted, dy.cols - 1);
      of_column[j] = c == wanted ? bias(0, c) : 0.0F;
#pragma unroll
      for (int i = 0; i < kWarpRows; ++i) d[i][j] = row[i][c];
    }
#pragma unroll
    for (int j = 0; j < kLaneColumns; ++j) {
      float sum = 0;
#pragma unroll
      for (int i = 0; i < kWarpRows; ++i) {
        dot[i] += d[i][j] * of_column[j];
        sum += d[i][j] * factor[i];
      }
      of_warp[warp][lane + j * kWarp] = sum;
    }
    __syncthreads();
    const auto c = static_cast<std::int32_t>(threadIdx.x);
    if (base + c < dy.cols) {
      float total = 0;
      for (int w = 0; w < kWarps; ++w) total += of_warp[w][c];
      partial(blockIdx.x, base + c) = total;
    }
    __syncthreads();  // the sums are read before the next columns' come
  }
  static_assert(kColumns == kThreads);
#pragma unroll
  for (int i = 0; i < kWarpRows; ++i) {
    const float total = warp_sum(dot[i]);
    if (lane == 0 && first + i < dy.rows) d_share(first + i, 0) = total;
  }
}

}  // namespace

void shared_bias_forward(View<const float> share, View<const float> bias, View<float> y) {
  if (y.size() == 0) return;
  forward_kernel<<<blocks_of(y.rows, kWarps), kThreads, 0, launch().stream>>>(share, bias, y);
  check_launch("shared bias");
}

void shared_bias_backward(const SharedBiasBackward& call, Workspace& arena) {
  if (call.dy.size() == 0) return;
  const Workspace::Scope scope(arena);
  const unsigned blocks = blocks_of(call.dy.rows, kBlockRows);
  const View<float> partial = arena.take<float>(blocks, call.dy.cols);
  backward_kernel<<<blocks, kThreads, 0, launch().stream>>>(call.share, call.bias, call.dy, call.d_share, partial);
  check_launch("gradient of a shared bias");
  add_partials(partial, call.d_bias);
}

}  // namespace semfield::cuda
