// Gradients of all weights in one kernel: d_weight = A^T B, sums over all rows, split over blocks by ranges of rows. A
// block computes 256 x 128 numbers (or 64 x 256) of one layer over its range: two warpgroups multiply, one warp feeds
// them by bulk copies, two more sum B's columns for the bias. Parts go to scratch memory and are added in order by a
// second kernel: the same bits in every run. Per row and layer: 1,024 bytes from memory (A a second time from the
// second-level cache), 2 256^2 operations.
#include <nv/target>

#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"

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
      if (!y.empty()) g[c] *= sigmoid_slope(y(row, c));
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

namespace {

constexpr int kHalf = 128;  // columns of B that a warpgroup multiplies
constexpr int kSumWarps = 2;
constexpr int kStages = 4;
constexpr std::uint32_t kStageBytes = kRows * (kWidth + kHalf) * 2;
constexpr int kMostJobs = 2 * kMostGradients;

struct Job {
  const __nv_bfloat16 *a, *b;
  int a_cols, b_cols;  // as stored
  int first, take;     // columns of B
  std::int64_t blocks;
  std::int64_t weight_at, bias_at;  // in a range's parts; bias_at < 0: not wanted
};
struct Work {
  Job jobs[kMostJobs];
  int count;
  std::int64_t blocks_each, ranges, parts;  // parts: floats of a range
  float* partial;                           // [ranges, parts]
};

__device__ constexpr std::uint32_t tile_bytes(int cols) { return kRows * static_cast<std::uint32_t>(cols) * 2; }

/// Stages of operands on their way through shared memory.
struct Stages {
  std::uint32_t memory, barriers, count = 0;
  static constexpr std::uint32_t kBarrierBytes = 16 * kStages;
  __device__ Stages(std::uint32_t memory_at, std::uint32_t barriers_at) : memory(memory_at), barriers(barriers_at) {}
  __device__ std::uint32_t full() const { return barriers + 16 * (count % kStages); }
  __device__ std::uint32_t empty() const { return full() + 8; }
  __device__ std::uint32_t at() const { return memory + count % kStages * kStageBytes; }
  __device__ std::uint32_t parity() const { return count / kStages % 2; }
  /// This warp's products will not read the stage any more that was given before the running one.
  __device__ void release_last() const {
    if (threadIdx.x % kWarp == 0) hopper::barrier_arrive(barriers + 16 * ((count - 1) % kStages) + 8);
  }
};

__device__ void feed(const Job& job, std::int64_t begin, std::int64_t end, Stages& stages) {
  const std::uint32_t a_bytes = tile_bytes(job.a_cols), b_bytes = tile_bytes(job.take);
  for (std::int64_t block = begin; block < end; ++block, ++stages.count) {
    hopper::barrier_wait(stages.empty(), stages.parity() ^ 1);
    hopper::barrier_expect(stages.full(), a_bytes + b_bytes);
    hopper::bulk_load(stages.at(), job.a + block * kRows * job.a_cols, a_bytes, stages.full());
    const __nv_bfloat16* from = job.b + block * kRows * job.b_cols + job.first * 8;
    const std::uint32_t to = stages.at() + a_bytes;
    if (job.take == job.b_cols) {
      hopper::bulk_load(to, from, b_bytes, stages.full());
    } else {
      for (std::uint32_t r = 0; r < kRows / 8; ++r) {
        hopper::bulk_load(to + r * row_step(job.take), from + r * 8 * static_cast<std::uint32_t>(job.b_cols),
                          row_step(job.take), stages.full());
      }
    }
  }
}

// kPieces x 64 rows of the gradient from column a_first of A, 128 columns from column b_first of the stage's B.
template <int kPieces>
__device__ inline void accumulate(float (&acc)[2][kHalf / 2], const Job& job, int a_first, int b_first,
                                  std::int64_t turns, Stages& stages) {
  const std::uint32_t a_step = row_step(job.a_cols), b_step = row_step(job.take);
  for (std::int64_t turn = 0; turn < turns; ++turn, ++stages.count) {
    hopper::barrier_wait(stages.full(), stages.parity());
    const std::uint32_t a = stages.at() + static_cast<std::uint32_t>(a_first) * 16;
    const std::uint32_t b = stages.at() + tile_bytes(job.a_cols) + static_cast<std::uint32_t>(b_first) * 16;
    hopper::wgmma_fence();
#pragma unroll
    for (int k = 0; k < kRows / 16; ++k) {
#pragma unroll
      for (int piece = 0; piece < kPieces; ++piece) {
        hopper::wgmma<true, true>(acc[piece],
                                  hopper::operand(a + 2 * k * a_step + piece * (kRows * 16), a_step, kBlockBytes),
                                  hopper::operand(b + 2 * k * b_step, b_step, kBlockBytes), true);
      }
    }
    hopper::wgmma_commit();
    if (turn > 0) {
      hopper::wgmma_wait<1>();
      stages.release_last();
    }
  }
  hopper::wgmma_wait<0>();
  if (turns > 0) stages.release_last();
}

__device__ void compute(const Job& job, float* parts, std::int64_t turns, int group, Stages& stages) {
  const Lane at;
  float acc[2][kHalf / 2] = {};
  const bool wide = job.a_cols == kWidth;
  const int a_first = wide ? group * 2 * kRows : 0, b_first = wide ? 0 : group * kHalf;
  if (wide) {
    accumulate<2>(acc, job, a_first, b_first, turns, stages);
  } else {
    accumulate<1>(acc, job, a_first, b_first, turns, stages);
  }
#pragma unroll
  for (int piece = 0; piece < 2; ++piece) {
    if (piece > 0 && !wide) break;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      float* to =
          parts + job.weight_at + (a_first + piece * kRows + at.row + 8 * half) * job.take + b_first + 2 * at.quad;
#pragma unroll
      for (int j = 0; j < kHalf / 8; ++j) {
        *reinterpret_cast<float2*>(to + 8 * j) =
            make_float2(acc[piece][4 * j + 2 * half], acc[piece][4 * j + 2 * half + 1]);
      }
    }
  }
}

// Column sums of B: a thread one row of every block of 8, and every 8th block of 8 columns.
__device__ void sum_columns(const Job& job, float* parts, std::int64_t turns, Stages& stages) {
  constexpr int kMost = kWidth / 64;
  const int thread = static_cast<int>(threadIdx.x) % hopper::kWarpgroup - 32;
  const std::uint32_t row = static_cast<std::uint32_t>(thread) % 8, col = static_cast<std::uint32_t>(thread) / 8;
  const int turns_of_columns = job.take / 64;
  float sum[kMost][8] = {};
  for (std::int64_t turn = 0; turn < turns; ++turn, ++stages.count) {
    hopper::barrier_wait(stages.full(), stages.parity());
    if (job.bias_at >= 0) {
      const std::uint32_t b = stages.at() + tile_bytes(job.a_cols) + col * kBlockBytes + row * 16;
#pragma unroll
      for (int i = 0; i < kMost; ++i) {
        if (i >= turns_of_columns) break;
#pragma unroll
        for (std::uint32_t r = 0; r < kRows / 8; ++r) {
          std::uint32_t word[4];
          asm volatile("ld.shared.v4.u32 {%0, %1, %2, %3}, [%4];"
                       : "=r"(word[0]), "=r"(word[1]), "=r"(word[2]), "=r"(word[3])
                       : "r"(b + r * row_step(job.take) + static_cast<std::uint32_t>(i) * 8 * kBlockBytes));
#pragma unroll
          for (int k = 0; k < 4; ++k) {
            sum[i][2 * k] += __uint_as_float(word[k] << 16);
            sum[i][2 * k + 1] += __uint_as_float(word[k] & 0xFFFF0000u);
          }
        }
      }
    }
    hopper::barrier_arrive(stages.empty());  // each lane for what it has read itself
  }
  if (job.bias_at < 0) return;
#pragma unroll
  for (int i = 0; i < kMost; ++i) {
    if (i >= turns_of_columns) break;
#pragma unroll
    for (int k = 0; k < 8; ++k) {
      float total = sum[i][k];
#pragma unroll
      for (int offset = 1; offset < 8; offset *= 2) total += __shfl_xor_sync(kFullMask, total, offset);
      if (row == 0) parts[job.bias_at + (static_cast<int>(col) + 8 * i) * 8 + k] = total;
    }
  }
}

[[maybe_unused]] __device__ void run(const Work& w) {
  extern __shared__ __align__(128) std::byte memory[];
  const std::uint32_t memory_at = hopper::shared_address(memory);
  Stages stages(memory_at, memory_at + kStages * kStageBytes);
  if (threadIdx.x == 0) {
    for (std::uint32_t s = 0; s < kStages; ++s) {
      hopper::barrier_init(stages.barriers + 16 * s, 1);
      hopper::barrier_init(stages.barriers + 16 * s + 8, kGroups * 4 + kSumWarps * kWarp);
    }
    hopper::fence_barrier_init();
  }
  __syncthreads();
  const int warp = static_cast<int>(threadIdx.x) / 32, group = warp / 4;
  for (std::int64_t item = blockIdx.x; item < w.ranges * w.count; item += gridDim.x) {
    const Job& job = w.jobs[item % w.count];
    const std::int64_t range = item / w.count, begin = range * w.blocks_each;
    const std::int64_t behind = begin + w.blocks_each < job.blocks ? begin + w.blocks_each : job.blocks;
    const std::int64_t end = behind > begin ? behind : begin;
    float* parts = w.partial + range * w.parts;
    if (group < kGroups) {
      compute(job, parts, end - begin, group, stages);
    } else if (warp == kGroups * 4) {
      if (threadIdx.x % 32 == 0) feed(job, begin, end, stages);
    } else if (warp <= kGroups * 4 + kSumWarps) {
      sum_columns(job, parts, end - begin, stages);
    }
  }
}

__global__ void __launch_bounds__(kThreads, 1) weight_gradient_kernel(const __grid_constant__ Work w) {
  NV_IF_TARGET(NV_HAS_FEATURE_SM_90a, (run(w);))
}

/// Where the parts of a gradient lie, and where their sum goes.
struct Sum {
  float *weight, *bias;
  std::int64_t weight_at, bias_at, weight_stride;
  int a_cols, rows, cols, take;
};
struct Sums {
  Sum all[kMostGradients];
  std::int64_t ranges, parts;
  const float* partial;
};

// blockIdx.y: gradient; a thread one number: its parts in order.
__global__ void add_parts_kernel(const __grid_constant__ Sums s) {
  const Sum& sum = s.all[blockIdx.y];
  const int i = static_cast<int>(blockIdx.x * blockDim.x + threadIdx.x);
  const int size = sum.rows * sum.cols;
  const bool is_bias = i >= size;
  if (is_bias && (sum.bias == nullptr || i >= size + sum.cols)) return;
  const int row = i / sum.cols, col = i % sum.cols;
  const std::int64_t at = is_bias ? sum.bias_at + (i - size)
                                  : sum.weight_at + static_cast<std::int64_t>(col / sum.take) * sum.a_cols * sum.take +
                                        static_cast<std::int64_t>(row) * sum.take + col % sum.take;
  float total = 0;
#pragma unroll 8
  for (std::int64_t range = 0; range < s.ranges; ++range) total += s.partial[range * s.parts + at];
  float* to = is_bias ? sum.bias + (i - size) : sum.weight + row * sum.weight_stride + col;
  *to += total;
}

}  // namespace

void weight_gradients(const WeightGradients& call, Workspace& arena) {
  const Workspace::Scope scope(arena);
  Work w{};
  Sums sums{};
  int most = 0;
  std::int64_t blocks = 0;
  for (int g = 0; g < call.count; ++g) {
    const WeightGradient& gradient = call.all[static_cast<std::size_t>(g)];
    const bool wide = gradient.a_cols == kWidth;
    const int take = wide ? kHalf : kWidth;
    if ((!wide && gradient.a_cols != kPosition) || gradient.b_cols % take != 0) {
      throw Error(ErrorKind::internal, "internal.cuda.shape",
                  "a weight gradient of a shape that the fused kernel has not");
    }
    const bool biased = !gradient.d_bias.empty();
    blocks = std::max(blocks, gradient.blocks);
    Sum& sum = sums.all[g];
    sum.weight = gradient.d_weight.data;
    sum.bias = gradient.d_bias.data;
    sum.weight_stride = gradient.d_weight.row_stride;
    sum.a_cols = gradient.a_cols;
    sum.rows = static_cast<int>(gradient.d_weight.rows);
    sum.cols = gradient.b_cols;
    sum.take = take;
    sum.weight_at = w.parts;
    sum.bias_at = w.parts + static_cast<std::int64_t>(gradient.a_cols) * gradient.b_cols;
    most = std::max(most, sum.rows * sum.cols + sum.cols);
    for (int first = 0; first < gradient.b_cols; first += take) {
      w.jobs[w.count++] = {gradient.a,
                           gradient.b,
                           gradient.a_cols,
                           gradient.b_cols,
                           first,
                           take,
                           gradient.blocks,
                           sum.weight_at + static_cast<std::int64_t>(gradient.a_cols) * first,
                           biased ? sum.bias_at + first : -1};
    }
    w.parts = sum.bias_at + gradient.b_cols;
  }
  if (blocks == 0) return;
  const std::int64_t two_turns = std::max(1, 2 * multiprocessors() / w.count);
  w.blocks_each = (blocks + two_turns - 1) / two_turns;
  w.ranges = (blocks + w.blocks_each - 1) / w.blocks_each;
  w.partial = arena.take<float>(w.ranges, static_cast<std::int32_t>(w.parts)).data;
  constexpr std::uint32_t kShared = kStages * kStageBytes + Stages::kBarrierBytes;
  check(cudaFuncSetAttribute(weight_gradient_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                             static_cast<int>(kShared)),
        "nerf_mlp gradients of weights");
  const std::int64_t device = multiprocessors();
  const auto grid = static_cast<unsigned>(std::min(w.ranges * w.count, device));
  weight_gradient_kernel<<<grid, kThreads, kShared, launch().stream>>>(w);
  check_launch("nerf_mlp gradients of weights");
  sums.ranges = w.ranges;
  sums.parts = w.parts;
  sums.partial = w.partial;
  constexpr int kSumThreads = 256;
  const dim3 sum_grid(blocks_of(most, kSumThreads), static_cast<unsigned>(call.count));
  add_parts_kernel<<<sum_grid, kSumThreads, 0, launch().stream>>>(sums);
  check_launch("nerf_mlp sums of gradients");
}

}  // namespace semfield::cuda::fused
