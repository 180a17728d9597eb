// Products of the small network for layers of any width: tiles in shared memory, sums in registers. Chosen where the
// fused kernels do not apply; fp32 runs and widths that are not usual.
#include <cuda_bf16.h>

#include <algorithm>

#include "cuda/kernels/device_code.cuh"
#include "fields/tiny_mlp/tiny_mlp_math.h"
#include "fields/tiny_mlp/tiny_mlp_partials.cuh"
#include "fields/tiny_mlp/tiny_mlp_products.cuh"

namespace semfield::cuda::tiny {

namespace {

constexpr int kThreads = 256;
constexpr int kDepth = 16;      // terms of a sum that are in shared memory at a time
constexpr int kPad = 4;         // keeps rows of a tile 16-byte aligned and away from each other's banks
constexpr int kTileRows = 128;  // of a product
constexpr int kTileCols = 64;
constexpr int kGradTile = 64;  // both sides of a tile of a weight gradient

template <bool kRound>
__device__ inline float operand(float value) {
  return kRound ? __bfloat162float(__float2bfloat16_rn(value)) : value;
}

__device__ inline float finish(Epilogue epilogue, float value) {
  if (epilogue == Epilogue::relu) return value <= 0.0f ? 0.0f : value;  // NaN stays NaN
  return epilogue == Epilogue::sigmoid ? 1.0f / (1.0f + expf(-value)) : value;
}

/// One tile of c: 16 x 16 threads, thread (i, j) owns rows 8 i .. 8 i + 7 and columns 4 j .. 4 j + 3. Reads a once for
/// every 64 columns of c, b (small) from L2: 4 (K + N) bytes per row at N <= 64, 2 K N operations.
template <bool kRound>
__global__ void __launch_bounds__(kThreads) product_kernel(const Product p) {
  __shared__ __align__(16) float a_tile[kDepth][kTileRows + kPad];
  __shared__ __align__(16) float b_tile[kDepth][kTileCols + kPad];
  const std::int64_t row0 = static_cast<std::int64_t>(blockIdx.x) * kTileRows;
  const int col0 = static_cast<int>(blockIdx.y) * kTileCols;
  const std::int64_t rows = live_count(p.live, p.c.rows);
  const int depth = p.a.cols, cols = p.c.cols, thread = static_cast<int>(threadIdx.x);
  const std::int64_t row_mine = row0 + thread / 16 * 8;
  const int col_mine = col0 + thread % 16 * 4;

  float sum[8][4];
#pragma unroll
  for (int i = 0; i < 8; ++i) {
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const std::int64_t row = row_mine + i;
      const int col = col_mine + j;
      sum[i][j] = 0;
      if (row >= rows || col >= cols) continue;
      if (p.add) {
        sum[i][j] = p.c(row, col);
      } else if (!p.start.empty()) {
        sum[i][j] = p.start(p.ray_of_sample.empty() ? 0 : p.ray_of_sample(row, 0), col);
      }
    }
  }

  float next_a[kDepth * kTileRows / kThreads], next_b[kDepth * kTileCols / kThreads];
  const auto fetch = [&](int k0) {
#pragma unroll
    for (int i = 0; i < kDepth * kTileRows / kThreads; ++i) {
      const int e = thread + i * kThreads, k = k0 + e % kDepth;
      const std::int64_t row = row0 + e / kDepth;
      next_a[i] = row < rows && k < depth ? operand<kRound>(p.a(row, k)) : 0.0f;
    }
#pragma unroll
    for (int i = 0; i < kDepth * kTileCols / kThreads; ++i) {
      const int e = thread + i * kThreads;
      const int k = k0 + (p.transposed ? e % kDepth : e / kTileCols);
      const int col = col0 + (p.transposed ? e / kDepth : e % kTileCols);
      const bool inside = k < depth && col < cols;
      next_b[i] = inside ? operand<kRound>(p.transposed ? p.b(col, k) : p.b(k, col)) : 0.0f;
    }
  };
  const int stop = row0 < rows ? depth : 0;
  if (stop > 0) fetch(0);
  for (int k0 = 0; k0 < stop; k0 += kDepth) {
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kDepth * kTileRows / kThreads; ++i) {
      const int e = thread + i * kThreads;
      a_tile[e % kDepth][e / kDepth] = next_a[i];
    }
#pragma unroll
    for (int i = 0; i < kDepth * kTileCols / kThreads; ++i) {
      const int e = thread + i * kThreads;
      if (p.transposed) {
        b_tile[e % kDepth][e / kDepth] = next_b[i];
      } else {
        b_tile[e / kTileCols][e % kTileCols] = next_b[i];
      }
    }
    __syncthreads();
    if (k0 + kDepth < stop) fetch(k0 + kDepth);  // on its way while this tile is summed
#pragma unroll
    for (int k = 0; k < kDepth; ++k) {
      const float4 a0 = *reinterpret_cast<const float4*>(&a_tile[k][thread / 16 * 8]);
      const float4 a1 = *reinterpret_cast<const float4*>(&a_tile[k][thread / 16 * 8 + 4]);
      const float4 b4 = *reinterpret_cast<const float4*>(&b_tile[k][thread % 16 * 4]);
      const float a[8] = {a0.x, a0.y, a0.z, a0.w, a1.x, a1.y, a1.z, a1.w};
      const float b[4] = {b4.x, b4.y, b4.z, b4.w};
#pragma unroll
      for (int i = 0; i < 8; ++i) {
#pragma unroll
        for (int j = 0; j < 4; ++j) sum[i][j] = fmaf(a[i], b[j], sum[i][j]);
      }
    }
  }

#pragma unroll
  for (int i = 0; i < 8; ++i) {
    const std::int64_t row = row_mine + i;
    if (row >= p.c.rows) break;
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const int col = col_mine + j;
      if (col >= cols) break;
      float value = finish(p.epilogue, sum[i][j]);
      if (row >= rows || (!p.mask.empty() && !(p.mask(row, col) > 0.0f))) value = 0;
      p.c(row, col) = value;
    }
  }
}

/// partial [ranges, in out + out]: sums over one range of rows. Block (range, tile): 16 x 16 threads, thread (i, j)
/// owns inputs 4 i .. 4 i + 3 and outputs 4 j .. 4 j + 3; rows ascending. Reads x once for every 64 outputs and dz once
/// for every 64 inputs.
template <bool kRound>
__global__ void __launch_bounds__(kThreads)
    weight_gradient_kernel(const WeightGradient g, std::int64_t rows_a_range, float* __restrict__ partial) {
  __shared__ __align__(16) float x_tile[kDepth][kGradTile + kPad];
  __shared__ __align__(16) float z_tile[kDepth][kGradTile + kPad];
  const int inputs = g.x.cols, outputs = g.dz.cols, thread = static_cast<int>(threadIdx.x);
  const int out_tiles = (outputs + kGradTile - 1) / kGradTile;
  const int in0 = static_cast<int>(blockIdx.y) / out_tiles * kGradTile;
  const int out0 = static_cast<int>(blockIdx.y) % out_tiles * kGradTile;
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * rows_a_range;
  const std::int64_t live = live_count(g.live, g.dz.rows);
  const std::int64_t last = first + rows_a_range < live ? first + rows_a_range : live;

  float sum[4][4] = {};
  float bias_sum = 0;  // of column out0 + thread, in the first 64 threads
  constexpr int kLoads = kDepth * kGradTile / kThreads;
  float next_x[kLoads], next_z[kLoads], next_raw[kLoads];
  const auto fetch = [&](std::int64_t row0) {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int e = thread + i * kThreads, col = e % kGradTile;
      const std::int64_t row = row0 + e / kGradTile;
      next_x[i] = row < last && in0 + col < inputs ? operand<kRound>(g.x(row, in0 + col)) : 0.0f;
      next_raw[i] = row < last && out0 + col < outputs ? g.dz(row, out0 + col) : 0.0f;
      next_z[i] = operand<kRound>(next_raw[i]);
    }
  };
  if (first < last) fetch(first);
  for (std::int64_t row0 = first; row0 < last; row0 += kDepth) {
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int e = thread + i * kThreads;
      x_tile[e / kGradTile][e % kGradTile] = next_x[i];
      z_tile[e / kGradTile][e % kGradTile] = next_z[i];
      bias_sum += next_raw[i];  // e % 64 is thread % 64 for every i
    }
    __syncthreads();
    if (row0 + kDepth < last) fetch(row0 + kDepth);
#pragma unroll
    for (int k = 0; k < kDepth; ++k) {
      const float4 x4 = *reinterpret_cast<const float4*>(&x_tile[k][thread / 16 * 4]);
      const float4 z4 = *reinterpret_cast<const float4*>(&z_tile[k][thread % 16 * 4]);
      const float x[4] = {x4.x, x4.y, x4.z, x4.w}, z[4] = {z4.x, z4.y, z4.z, z4.w};
#pragma unroll
      for (int i = 0; i < 4; ++i) {
#pragma unroll
        for (int j = 0; j < 4; ++j) sum[i][j] = fmaf(x[i], z[j], sum[i][j]);
      }
    }
  }

  float* __restrict__ mine = partial + static_cast<std::int64_t>(blockIdx.x) * outputs * (inputs + 1);
#pragma unroll
  for (int i = 0; i < 4; ++i) {
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const int in = in0 + thread / 16 * 4 + i, out = out0 + thread % 16 * 4 + j;
      if (in < inputs && out < outputs) mine[static_cast<std::int64_t>(in) * outputs + out] = sum[i][j];
    }
  }
  if (in0 != 0) return;
  // A column's rows lie with four threads.
  __syncthreads();
  x_tile[thread / kGradTile][thread % kGradTile] = bias_sum;
  __syncthreads();
  if (thread < kGradTile && out0 + thread < outputs) {
    mine[static_cast<std::int64_t>(inputs) * outputs + out0 + thread] =
        (x_tile[0][thread] + x_tile[1][thread]) + (x_tile[2][thread] + x_tile[3][thread]);
  }
}

/// d_weight and d_bias += sum of the partials in order of their ranges.
__global__ void __launch_bounds__(kSumColumns* kSumSegments)
    sum_partials_kernel(const float* __restrict__ partial, int ranges, View<float> d_weight, View<float> d_bias,
                        int inputs, int outputs) {
  const std::int64_t size = static_cast<std::int64_t>(inputs + 1) * outputs;
  const std::int64_t element = static_cast<std::int64_t>(blockIdx.x) * kSumColumns + threadIdx.x;
  const float sum = sum_of_partials(partial, ranges, size, element);
  if (threadIdx.y != 0 || element >= size) return;
  const std::int64_t in = element / outputs;
  const int out = static_cast<int>(element % outputs);
  if (in < inputs) {
    if (!d_weight.empty()) d_weight(in, out) += sum;
  } else if (!d_bias.empty()) {
    d_bias(0, out) += sum;
  }
}

/// Block r sums ray r, a thread per column; the ray's range is found by bisection in ray_of_sample.
__global__ void sum_per_ray_kernel(View<const float> dz, View<const std::int32_t> ray_of_sample,
                                   const std::int32_t* live, View<float> d_ray_term) {
  __shared__ std::int64_t bounds[2];
  const auto ray = static_cast<std::int64_t>(blockIdx.x);
  if (threadIdx.x < 2) {
    std::int64_t low = 0, high = live_count(live, dz.rows);
    const std::int64_t wanted = ray + threadIdx.x;  // first row of a ray >= wanted
    while (low < high) {
      const std::int64_t middle = (low + high) / 2;
      if (ray_of_sample(middle, 0) < wanted) {
        low = middle + 1;
      } else {
        high = middle;
      }
    }
    bounds[threadIdx.x] = low;
  }
  __syncthreads();
  for (int col = static_cast<int>(threadIdx.x); col < dz.cols; col += static_cast<int>(blockDim.x)) {
    float sum = 0;
#pragma unroll 4
    for (std::int64_t row = bounds[0]; row < bounds[1]; ++row) sum += dz(row, col);
    d_ray_term(ray, col) = sum;
  }
}

/// One thread an element of the loops below.
struct Place {
  std::int64_t row;
  std::int32_t col;
};
__device__ inline bool place_of(std::int64_t rows, std::int32_t cols, Place& place) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= rows * cols) return false;
  place = {i / cols, static_cast<std::int32_t>(i % cols)};
  return true;
}

__global__ void copy_rows_kernel(View<const float> in, View<float> out, const std::int32_t* live, bool add) {
  Place at;
  if (!place_of(out.rows, out.cols, at)) return;
  const bool used = at.row < live_count(live, out.rows);
  const float value = used && !in.empty() ? in(at.row, at.col) : 0.0f;
  out(at.row, at.col) = add && used ? out(at.row, at.col) + value : value;
}

__global__ void mask_rows_kernel(View<const float> mask, View<float> out) {
  Place at;
  if (!place_of(out.rows, out.cols, at)) return;
  if (!(mask(at.row, at.col) > 0.0f)) out(at.row, at.col) = 0;
}

__global__ void gather_rows_kernel(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out) {
  Place at;
  if (!place_of(out.rows, out.cols, at)) return;
  out(at.row, at.col) = in(ray_of_sample(at.row, 0), at.col);
}

__global__ void logit_gradient_kernel(View<const float> rgb, View<const float> d_rgb, View<float> d_logit) {
  Place at;
  if (!place_of(d_logit.rows, d_logit.cols, at)) return;
  d_logit(at.row, at.col) = d_rgb(at.row, at.col) * tiny_mlp_sigmoid_slope(rgb(at.row, at.col));
}

unsigned tiles_of(std::int64_t count, int tile) { return blocks_of(count, tile); }

}  // namespace

void product(const Product& p, Precision precision) {
  if (p.c.size() == 0) return;
  const dim3 grid(tiles_of(p.c.rows, kTileRows), tiles_of(p.c.cols, kTileCols));
  if (precision == Precision::bf16) {
    product_kernel<true><<<grid, kThreads, 0, launch().stream>>>(p);
  } else {
    product_kernel<false><<<grid, kThreads, 0, launch().stream>>>(p);
  }
  check_launch("small network: product");
}

void weight_gradient(const WeightGradient& g, Precision precision, Workspace& arena) {
  constexpr std::int64_t kMinRows = 256, kMaxRanges = 256;
  constexpr std::int64_t kPartialFloats = std::int64_t{1} << 24;  // 64 MB of partial sums at most
  if (g.dz.size() == 0 || (g.d_weight.empty() && g.d_bias.empty())) return;
  const Workspace::Scope scope(arena);
  const std::int64_t size = static_cast<std::int64_t>(g.dz.cols) * (g.x.cols + 1);
  const std::int64_t most = std::clamp<std::int64_t>(kPartialFloats / size, 1, kMaxRanges);
  const std::int64_t rows_a_range = std::max(kMinRows, (g.dz.rows + most - 1) / most);
  const auto ranges = static_cast<int>((g.dz.rows + rows_a_range - 1) / rows_a_range);
  const View<float> partial = arena.take<float>(ranges, static_cast<std::int32_t>(size));
  const dim3 grid(static_cast<unsigned>(ranges), tiles_of(g.x.cols, kGradTile) * tiles_of(g.dz.cols, kGradTile));
  if (precision == Precision::bf16) {
    weight_gradient_kernel<true><<<grid, kThreads, 0, launch().stream>>>(g, rows_a_range, partial.data);
  } else {
    weight_gradient_kernel<false><<<grid, kThreads, 0, launch().stream>>>(g, rows_a_range, partial.data);
  }
  check_launch("small network: weight gradient");
  sum_partials_kernel<<<tiles_of(size, kSumColumns), dim3(kSumColumns, kSumSegments), 0, launch().stream>>>(
      partial.data, ranges, g.d_weight, g.d_bias, g.x.cols, g.dz.cols);
  check_launch("small network: sum of partial gradients");
}

void sum_per_ray(View<const float> dz, View<const std::int32_t> ray_of_sample, const std::int32_t* live,
                 View<float> d_ray_term) {
  if (d_ray_term.size() == 0) return;
  sum_per_ray_kernel<<<static_cast<unsigned>(d_ray_term.rows), 64, 0, launch().stream>>>(dz, ray_of_sample, live,
                                                                                         d_ray_term);
  check_launch("small network: sums of rays");
}

void copy_rows(View<const float> in, View<float> out, const std::int32_t* live, bool add) {
  if (out.size() == 0) return;
  copy_rows_kernel<<<blocks_of(out.size(), kThreads), kThreads, 0, launch().stream>>>(in, out, live, add);
  check_launch("small network: copy");
}

void mask_rows(View<const float> mask, View<float> out) {
  if (out.size() == 0) return;
  mask_rows_kernel<<<blocks_of(out.size(), kThreads), kThreads, 0, launch().stream>>>(mask, out);
  check_launch("small network: mask");
}

void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out) {
  if (out.size() == 0) return;
  gather_rows_kernel<<<blocks_of(out.size(), kThreads), kThreads, 0, launch().stream>>>(in, ray_of_sample, out);
  check_launch("small network: directions of samples");
}

void logit_gradient(View<const float> rgb, View<const float> d_rgb, View<float> d_logit) {
  if (d_logit.size() == 0) return;
  logit_gradient_kernel<<<blocks_of(d_logit.size(), kThreads), kThreads, 0, launch().stream>>>(rgb, d_rgb, d_logit);
  check_launch("small network: gradient of a colour's logit");
}

}  // namespace semfield::cuda::tiny
