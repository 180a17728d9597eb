// What the fused kernels read and leave, in their layouts: weights in slabs, the position in blocks; and the narrow
// sums over blocked activations.
#include "cuda/kernels/device_code.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"
#include "fields/nerf_mlp/nerf_mlp_math.h"

namespace semfield::cuda::fused {

namespace {

constexpr int kPackThreads = 256;

union Eight {
  uint4 bits;
  __nv_bfloat16 v[8];
};

// Element of a blocked matrix.
__device__ inline std::int64_t blocked_at(std::int64_t row, int col, int cols) {
  return (row / 8 * (cols / 8) + col / 8) * 64 + row % 8 * 8 + col % 8;
}

struct SlabJob {
  const float *from, *second;
  std::int64_t stride, second_stride;
  std::byte* to;
  int terms, columns, slabs, second_at;  // columns from second_at on are the second matrix's
  bool transposed;
};
struct SlabJobs {
  SlabJob all[kMostSlabs];
};

// blockIdx.y: matrix; a thread 8 terms of one column: 32 bytes read, 16 written.
__global__ void pack_slabs_kernel(const __grid_constant__ SlabJobs jobs) {
  const SlabJob& job = jobs.all[blockIdx.y];
  const int i = static_cast<int>(blockIdx.x * blockDim.x + threadIdx.x);
  if (i >= job.slabs * (kTerms / 8) * job.columns) return;
  const bool second = i % job.columns >= job.second_at;
  const int column = i % job.columns - (second ? job.second_at : 0), term = i / job.columns * 8;
  const float* const from = second ? job.second : job.from;
  const std::int64_t stride = second ? job.second_stride : job.stride;
  Eight eight;
#pragma unroll
  for (int k = 0; k < 8; ++k) {
    const std::int64_t at = job.transposed ? column * stride + term + k : (term + k) * stride + column;
    eight.v[k] = __float2bfloat16_rn(term + k < job.terms ? from[at] : 0.0F);
  }
  reinterpret_cast<uint4*>(job.to)[i] = eight.bits;
}

// A thread 8 numbers of a row: 32 bytes read, 16 written.
__global__ void pack_position_kernel(View<const float> position, std::int64_t rows, uint4* blocked) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const std::int64_t row = i / (kPosition / 8);
  const int col = static_cast<int>(i % (kPosition / 8)) * 8;
  if (row >= rows) return;
  Eight eight;
#pragma unroll
  for (int k = 0; k < 8; ++k) {
    eight.v[k] = __float2bfloat16_rn(row < position.rows && col + k < position.cols ? position(row, col + k) : 0.0F);
  }
  blocked[blocked_at(row, col, kPosition) / 8] = eight.bits;
}

__global__ void unpack_kernel(const __nv_bfloat16* blocked, View<float> rows) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= rows.size()) return;
  const std::int64_t row = i / rows.cols;
  const auto col = static_cast<std::int32_t>(i % rows.cols);
  rows(row, col) = __bfloat162float(blocked[blocked_at(row, col, rows.cols)]);
}

// First of `count` ascending numbers that is not below `value`: a warp looks at 32 of them at a time.
__device__ inline std::int64_t lower_bound(const View<const std::int32_t>& numbers, std::int64_t count,
                                           std::int64_t value) {
  const auto lane = static_cast<std::int64_t>(threadIdx.x % kWarp);
  std::int64_t low = 0, high = count;
  while (low < high) {
    const std::int64_t stride = (high - low + kWarp) / (kWarp + 1), probe = low + (lane + 1) * stride - 1;
    const bool below = probe < high && numbers(probe, 0) < value;
    const int found = __popc(__ballot_sync(kFullMask, below));
    if (found < kWarp && low + (found + 1) * stride - 1 < high) high = low + (found + 1) * stride - 1;
    low += found * stride;
  }
  return low;
}

// A block of 128 threads a ray: a thread 8 columns of every 8th row, then the 8 sums of a column in order. 256 bytes a
// row.
__global__ void per_ray_kernel(const uint4* d_hidden, View<const std::int32_t> ray_of_sample, std::int64_t rows,
                               const std::int32_t* live_rows, View<float> d_ray_term) {
  constexpr int kVectors = kView / 8, kSlots = 8;
  __shared__ float share[kSlots][kView];
  __shared__ std::int64_t ends[2];
  const std::int64_t ray = blockIdx.x;
  const auto warp = static_cast<int>(threadIdx.x) / kWarp;
  if (warp < 2) {
    const std::int64_t place = lower_bound(ray_of_sample, live_count(live_rows, rows), ray + warp);
    if (threadIdx.x % kWarp == 0) ends[warp] = place;
  }
  __syncthreads();
  const std::int64_t begin = ends[0], end = ends[1];
  // Lanes of 8 neighbouring rows read 128 contiguous bytes.
  const int slot = static_cast<int>(threadIdx.x) % kSlots, vector = static_cast<int>(threadIdx.x) / kSlots;
  float sum[8] = {};
#pragma unroll 8
  for (std::int64_t row = begin + slot; row < end; row += kSlots) {
    Eight eight;
    eight.bits = d_hidden[blocked_at(row, vector * 8, kView) / 8];
#pragma unroll
    for (int k = 0; k < 8; ++k) sum[k] += __bfloat162float(eight.v[k]);
  }
  static_assert(kVectors * kSlots == 128);
#pragma unroll
  for (int k = 0; k < 8; ++k) share[slot][vector * 8 + k] = sum[k];
  __syncthreads();
  float total = 0;
#pragma unroll
  for (int s = 0; s < kSlots; ++s) total += share[s][threadIdx.x];
  d_ray_term(ray, static_cast<std::int32_t>(threadIdx.x)) = total;
}

// A block: a range of rows, in steps of 8 rows for each of its warps; a lane one row and every 4th vector of 8 columns,
// which it sums over its rows. partial [blocks, cols kChannelsOf + kChannelsOf]. 2 cols + 4 kChannelsOf (8 with y)
// bytes per row.
template <int kCols, int kChannelsOf>
__global__ void __launch_bounds__(kPackThreads, 2)
    head_gradient_kernel(const uint4* x, View<const float> d, View<const float> y, std::int64_t rows_each,
                         View<float> partial) {
  constexpr int kWarps = kPackThreads / kWarp, kVectors = kCols / 8 / 4;
  static_assert(kVectors * 32 == kCols);
  __shared__ float share[kWarps][kCols];
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < d.rows ? begin + rows_each : d.rows;
  const int warp = static_cast<int>(threadIdx.x) / kWarp, lane = static_cast<int>(threadIdx.x) % kWarp;
  const int slot = lane % 8, part = lane / 8;
  float sum[kChannelsOf][kVectors][8] = {}, bias[kChannelsOf] = {};
  for (std::int64_t row = begin + warp * 8 + slot; row < end; row += kWarps * 8) {
    float g[kChannelsOf];
#pragma unroll
    for (int c = 0; c < kChannelsOf; ++c) {
      g[c] = d(row, c);
      if (!y.empty()) g[c] *= nerf_mlp_sigmoid_slope(y(row, c));
      bias[c] += g[c];
    }
#pragma unroll
    for (int v = 0; v < kVectors; ++v) {
      Eight eight;
      eight.bits = x[blocked_at(row, (v * 4 + part) * 8, kCols) / 8];
#pragma unroll
      for (int k = 0; k < 8; ++k) {
        const float value = __bfloat162float(eight.v[k]);
#pragma unroll
        for (int c = 0; c < kChannelsOf; ++c) sum[c][v][k] = fmaf(value, g[c], sum[c][v][k]);
      }
    }
  }
  // Over the 8 rows of a warp by shuffles, then over warps in order.
#pragma unroll
  for (int c = 0; c < kChannelsOf; ++c) {
    __syncthreads();
#pragma unroll
    for (int v = 0; v < kVectors; ++v) {
#pragma unroll
      for (int k = 0; k < 8; ++k) {
        float value = sum[c][v][k];
        for (int offset = 1; offset < 8; offset *= 2) value += __shfl_xor_sync(kFullMask, value, offset);
        if (slot == 0) share[warp][(v * 4 + part) * 8 + k] = value;
      }
    }
    __syncthreads();
    for (int col = static_cast<int>(threadIdx.x); col < kCols; col += kPackThreads) {
      float total = 0;
      for (int w = 0; w < kWarps; ++w) total += share[w][col];
      partial(blockIdx.x, col * kChannelsOf + c) = total;
    }
    __syncthreads();
    float value = bias[c];  // the four lanes of a row hold the same
    for (int offset = 1; offset < 8; offset *= 2) value += __shfl_xor_sync(kFullMask, value, offset);
    if (lane == 0) share[warp][0] = value;
    __syncthreads();
    if (threadIdx.x == 0) {
      float total = 0;
      for (int w = 0; w < kWarps; ++w) total += share[w][0];
      partial(blockIdx.x, kCols * kChannelsOf + c) = total;
    }
  }
}

// A head's parts [ranges, cols (1 or 3)] with the bias in the last columns, and where their sums go.
struct HeadParts {
  View<float> partial;
  float *weight = nullptr, *bias = nullptr;
  std::int32_t weights = 0;
};
struct BothHeadParts {
  HeadParts all[2];
};

// blockIdx.y: head; a block of 32 x 32 threads 32 columns: thread (x, y) the parts y, y + 32, ..., then those 32 sums
// in order.
__global__ void add_head_parts_kernel(const __grid_constant__ BothHeadParts heads) {
  __shared__ float share[kWarp][kWarp + 1];
  const HeadParts& head = heads.all[blockIdx.y];
  const auto x = static_cast<std::int32_t>(threadIdx.x), y = static_cast<std::int32_t>(threadIdx.y);
  const std::int32_t col = static_cast<std::int32_t>(blockIdx.x) * kWarp + x;
  float sum = 0;
  if (col < head.partial.cols) {
#pragma unroll 8
    for (std::int64_t part = y; part < head.partial.rows; part += kWarp) sum += head.partial(part, col);
  }
  share[y][x] = sum;
  __syncthreads();
  if (y > 0 || col >= head.partial.cols) return;
  float total = 0;
  for (int k = 0; k < kWarp; ++k) total += share[k][x];
  (col < head.weights ? head.weight[col] : head.bias[col - head.weights]) += total;
}

template <int kCols, int kChannelsOf>
HeadParts head_parts(const HeadGradient& call, Workspace& arena) {
  constexpr std::int64_t kLeastRows = 256;
  const std::int64_t wanted =
      std::min<std::int64_t>(2 * multiprocessors(), (call.d.rows + kLeastRows - 1) / kLeastRows);
  const std::int64_t rows_each = ((call.d.rows + wanted - 1) / wanted + 7) / 8 * 8;
  HeadParts parts;
  parts.partial = arena.take<float>((call.d.rows + rows_each - 1) / rows_each, (kCols + 1) * kChannelsOf);
  parts.weight = call.d_weight.data;
  parts.bias = call.d_bias.data;
  parts.weights = kCols * kChannelsOf;
  head_gradient_kernel<kCols, kChannelsOf>
      <<<static_cast<unsigned>(parts.partial.rows), kPackThreads, 0, launch().stream>>>(
          reinterpret_cast<const uint4*>(call.x), call.d, call.y, rows_each, parts.partial);
  check_launch("nerf_mlp gradients of a head");
  return parts;
}

}  // namespace

std::size_t slab_bytes(const std::array<Slabs, kMostSlabs>& all, int count) {
  std::size_t bytes = 0;
  for (int i = 0; i < count; ++i) {
    const Slabs& s = all[static_cast<std::size_t>(i)];
    bytes += static_cast<std::size_t>(s.slabs * s.columns) * kTerms * sizeof(__nv_bfloat16);
  }
  return bytes;
}

void pack_slabs(const std::array<Slabs, kMostSlabs>& all, int count, std::byte* to) {
  SlabJobs jobs{};
  int most = 0;
  for (int i = 0; i < count; ++i) {
    const Slabs& s = all[static_cast<std::size_t>(i)];
    const auto terms = static_cast<int>(s.transposed ? s.weight.cols : s.weight.rows);
    SlabJob& job = jobs.all[i];
    job.from = s.weight.data;
    job.stride = s.weight.row_stride;
    job.second = s.beside.data;
    job.second_stride = s.beside.row_stride;
    job.to = to;
    job.terms = terms;
    job.columns = s.columns;
    job.slabs = s.slabs;
    job.second_at = s.beside.empty() ? s.columns : s.weight.cols;
    job.transposed = s.transposed;
    to += static_cast<std::size_t>(s.slabs * s.columns) * kTerms * sizeof(__nv_bfloat16);
    most = std::max(most, s.slabs * (kTerms / 8) * s.columns);
  }
  if (most == 0) return;
  const dim3 grid(blocks_of(most, kPackThreads), static_cast<unsigned>(count));
  pack_slabs_kernel<<<grid, kPackThreads, 0, launch().stream>>>(jobs);
  check_launch("nerf_mlp weights in slabs");
}

void pack_position(View<const float> position, std::int64_t blocks, __nv_bfloat16* blocked) {
  const std::int64_t rows = blocks * kRows;
  pack_position_kernel<<<blocks_of(rows * (kPosition / 8), kPackThreads), kPackThreads, 0, launch().stream>>>(
      position, rows, reinterpret_cast<uint4*>(blocked));
  check_launch("nerf_mlp position in blocks");
}

void unpack(const __nv_bfloat16* blocked, View<float> rows) {
  if (rows.size() == 0) return;
  unpack_kernel<<<blocks_of(rows.size(), kPackThreads), kPackThreads, 0, launch().stream>>>(blocked, rows);
  check_launch("nerf_mlp rows of blocks");
}

void per_ray_sums(const __nv_bfloat16* d_hidden, View<const std::int32_t> ray_of_sample, View<float> d_ray_term) {
  if (d_ray_term.rows == 0) return;
  per_ray_kernel<<<static_cast<unsigned>(d_ray_term.rows), kView, 0, launch().stream>>>(
      reinterpret_cast<const uint4*>(d_hidden), ray_of_sample, ray_of_sample.rows, launch().live_rows, d_ray_term);
  check_launch("nerf_mlp sums over rays");
}

void head_gradients(const HeadGradient& density, const HeadGradient& color, Workspace& arena) {
  const Workspace::Scope scope(arena);
  BothHeadParts heads;
  unsigned count = 0;
  if (density.d.rows > 0) heads.all[count++] = head_parts<kWidth, 1>(density, arena);
  if (color.d.rows > 0) heads.all[count++] = head_parts<kView, kChannels>(color, arena);
  if (count == 0) return;
  const dim3 grid(blocks_of((kView + 1) * kChannels, kWarp), count);
  static_assert((kView + 1) * kChannels >= kWidth + 1);
  add_head_parts_kernel<<<grid, dim3(kWarp, kWarp), 0, launch().stream>>>(heads);
  check_launch("nerf_mlp sums of heads");
}

}  // namespace semfield::cuda::fused
