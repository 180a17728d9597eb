// Gradients of all weights in one kernel: d_weight = A^T B, sums over all rows, split over blocks by ranges of rows. A
// block computes 256 x 128 numbers (or 64 x 256) of one layer over its range: two warpgroups multiply, one warp feeds
// them by bulk copies, two more sum B's columns for the bias. Parts go to scratch memory and are added in order by a
// second kernel: the same bits in every run. Per row and layer: 1,024 bytes from memory (A a second time from the
// second-level cache), 2 256^2 operations.
#include <nv/target>

#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"

namespace semfield::cuda::fused {

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
  const std::int64_t device = std::int64_t{multiprocessors()} * launch().beside;
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
