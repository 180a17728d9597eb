// Forward through all layers in one kernel. A warpgroup: 64 rows, 64 x 256 sums in registers; the layer's input is read
// from shared memory, its output goes there (and to memory when a backward follows). Weights stream through a ring that
// one thread of the third warpgroup fills. Per row: 128 bytes of position read; written with a backward 512 depth + 256
// + 32 depth + 16, with a feature 1,024, colour and density 16; weights come from the second-level cache, 1 MB for
// every 256 rows. 2 (64 256 2 + 256^2 (depth - 1) + 256 128) operations a row, padding of the position included.
// Results are the same bits in every run and for every batch.
#include <nv/target>

#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"

namespace semfield::cuda::fused {

namespace {

using hopper::barrier_wait;

// Shared memory, in this order from its aligned start.
struct Shared {
  std::uint32_t slabs, tiles, positions, barriers;
  float *bias, *density, *color, *view_bias;  // [depth, 256], [256], [3, 128], [128]
  static constexpr std::uint32_t kFloats = kSlabBytes * kStages + (kTileBytes + kPositionBytes) * kGroups;
  static constexpr std::uint32_t kBarrierBytes = Ring::kBarrierBytes + 16 * kGroups;
  static constexpr std::uint32_t bytes(int depth) {
    return kFloats + static_cast<std::uint32_t>(depth * kWidth + kWidth + (kChannels + 1) * kView) * 4 + kBarrierBytes;
  }
  __device__ Shared(std::byte* memory, int depth) {
    slabs = hopper::shared_address(memory);
    tiles = slabs + kSlabBytes * kStages;
    positions = tiles + kTileBytes * kGroups;
    bias = reinterpret_cast<float*>(memory + kFloats);
    density = bias + depth * kWidth;
    color = density + kWidth;
    view_bias = color + kChannels * kView;
    barriers = hopper::shared_address(view_bias + kView);
  }
  __device__ Ring ring() const { return {slabs, barriers}; }
  __device__ std::uint32_t position_full(int group) const {
    return barriers + Ring::kBarrierBytes + 16 * static_cast<std::uint32_t>(group);
  }
  __device__ std::uint32_t position_empty(int group) const { return position_full(group) + 8; }
};

__device__ void feed(const Forward& p, const Shared& sh, const Tiles& tiles) {
  Ring ring = sh.ring();
  const int trunk_slabs = (p.depth - 1) * (kWidth / kTerms) + 1 + (p.skip_at > 0 ? 1 : 0);
  const int view_slabs = p.rgb.empty() ? 0 : kWidth / kTerms;
  std::uint32_t turn = 0;
  for (std::int64_t tile = tiles.first; tile < tiles.count; tile += tiles.step, ++turn) {
    for (int group = 0; group < kGroups; ++group) {
      barrier_wait(sh.position_empty(group), turn % 2 ^ 1);
      hopper::barrier_expect(sh.position_full(group), kPositionBytes);
      hopper::bulk_load(sh.positions + static_cast<std::uint32_t>(group) * kPositionBytes,
                        p.position + tiles.block(tile, group) * (kRows * kPosition), kPositionBytes,
                        sh.position_full(group));
    }
    const std::byte* from = p.weights;
    for (int s = 0; s < trunk_slabs; ++s, from += kSlabBytes) ring.feed(from, kSlabBytes, tiles.rank);
    for (int s = 0; s < view_slabs; ++s, from += kViewSlabBytes) ring.feed(from, kViewSlabBytes, tiles.rank);
  }
}

// acc = max(acc + bias, 0) with the bits of what stays above 0; NaN stays NaN.
template <int kColumns>
__device__ inline MaskBits<kColumns> rectify(float (&acc)[kColumns / 2], const float* bias, int quad) {
  MaskBits<kColumns> mask{};
#pragma unroll
  for (int j = 0; j < kColumns / 8; ++j) {
    const float2 b = *reinterpret_cast<const float2*>(bias + 8 * j + 2 * quad);
#pragma unroll
    for (int e = 0; e < 4; ++e) {
      const float value = acc[4 * j + e] + (e % 2 == 0 ? b.x : b.y);
      acc[4 * j + e] = value < 0 ? 0.0F : value;
      if (value > 0) mask.word[j / 8] |= 1u << (j % 8 * 4 + e);
    }
  }
  return mask;
}

__device__ inline void density_and_feature(const Forward& p, const float (&acc)[kWidth / 2], const float* weight,
                                           std::int64_t row, int quad) {
  if (!p.sigma.empty()) {
    float sum[2] = {0, 0};
#pragma unroll
    for (int j = 0; j < kWidth / 8; ++j) {
      const float2 w = *reinterpret_cast<const float2*>(weight + 8 * j + 2 * quad);
      sum[0] = fmaf(acc[4 * j + 1], w.y, fmaf(acc[4 * j], w.x, sum[0]));
      sum[1] = fmaf(acc[4 * j + 3], w.y, fmaf(acc[4 * j + 2], w.x, sum[1]));
    }
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const float total = row_sum(sum[half]);
      if (quad == 0 && row + 8 * half < p.rows) p.sigma(row + 8 * half, 0) = total + p.density_bias[0];
    }
  }
  if (p.feature.empty() && p.rounded_feature.empty()) return;
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    if (row + 8 * half >= p.rows) continue;
    if (!p.rounded_feature.empty()) {
      __nv_bfloat16* to = p.rounded_feature.row(row + 8 * half) + 2 * quad;
#pragma unroll
      for (int j = 0; j < kWidth / 8; ++j) {
        *reinterpret_cast<__nv_bfloat162*>(to + 8 * j) =
            __floats2bfloat162_rn(acc[4 * j + 2 * half], acc[4 * j + 2 * half + 1]);
      }
      continue;
    }
    float* to = p.feature.row(row + 8 * half) + 2 * quad;
#pragma unroll
    for (int j = 0; j < kWidth / 8; ++j) {
      *reinterpret_cast<float2*>(to + 8 * j) = make_float2(acc[4 * j + 2 * half], acc[4 * j + 2 * half + 1]);
    }
  }
}

// The view layer's ReLU, with the ray's part, and the colour.
__device__ inline MaskBits<kView> color(const Forward& p, float (&acc)[kView / 2], const float* weight,
                                        const float* view_bias, std::int64_t row, int quad) {
  const float* term[2] = {view_bias, view_bias};
  if (!p.ray_term.empty()) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const std::int64_t sample = row + 8 * half < p.rows ? row + 8 * half : p.rows - 1;
      term[half] = p.ray_term.row(p.ray_of_sample(sample, 0));
    }
  }
  MaskBits<kView> mask{};
  float sum[2][kChannels] = {};
#pragma unroll
  for (int j = 0; j < kView / 8; ++j) {
    const float2 first = *reinterpret_cast<const float2*>(term[0] + 8 * j + 2 * quad);
    const float2 second = *reinterpret_cast<const float2*>(term[1] + 8 * j + 2 * quad);
    const float of[4] = {first.x, first.y, second.x, second.y};
#pragma unroll
    for (int e = 0; e < 4; ++e) {
      const float value = acc[4 * j + e] + of[e];
      acc[4 * j + e] = value < 0 ? 0.0F : value;
      if (value > 0) mask.word[j / 8] |= 1u << (j % 8 * 4 + e);
    }
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      const float2 w = *reinterpret_cast<const float2*>(weight + c * kView + 8 * j + 2 * quad);
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        sum[half][c] = fmaf(acc[4 * j + 2 * half + 1], w.y, fmaf(acc[4 * j + 2 * half], w.x, sum[half][c]));
      }
    }
  }
#pragma unroll
  for (int half = 0; half < 2; ++half) {
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      const float logit = row_sum(sum[half][c]) + p.color_bias[c];
      if (quad == 0 && row + 8 * half < p.rows) p.rgb(row + 8 * half, c) = 1 / (1 + expf(-logit));
    }
  }
  return mask;
}

__device__ void compute(const Forward& p, const Shared& sh, const Tiles& tiles, int group) {
  const Lane at;
  Ring ring = sh.ring();
  const std::uint32_t tile_at = sh.tiles + static_cast<std::uint32_t>(group) * kTileBytes;
  const std::uint32_t position_at = sh.positions + static_cast<std::uint32_t>(group) * kPositionBytes;
  const bool saves = p.trunk != nullptr;
  std::uint32_t turn = 0;
  for (std::int64_t tile = tiles.first; tile < tiles.count; tile += tiles.step, ++turn) {
    const std::int64_t block = tiles.block(tile, group);
    const std::int64_t row = block * kRows + at.row;
    float acc[kWidth / 2] = {};  // defined, so that no registers are kept for it across tiles
    barrier_wait(sh.position_full(group), turn % 2);
    for (int i = 0; i < p.depth; ++i) {
      const bool reads_position = i == 0 || i == p.skip_at;
      if (reads_position) multiply<kWidth>(acc, position_at, row_step(kPosition), 1, ring, true);
      if (i > 0) multiply<kWidth>(acc, tile_at, row_step(kWidth), kWidth / kTerms, ring, !reads_position);
      if (i == p.skip_at && at.lane == 0) hopper::barrier_arrive(sh.position_empty(group));
      const MaskBits<kWidth> mask = rectify<kWidth>(acc, sh.bias + i * kWidth, at.quad);
      const std::int64_t piece = i * p.blocks + block;
      if (saves) {
        p.trunk_mask[piece * hopper::kWarpgroup + at.thread] =
            make_uint4(mask.word[0], mask.word[1], mask.word[2], mask.word[3]);
      }
      if (i == p.depth - 1) density_and_feature(p, acc, sh.density, row, at.quad);
      tile_is_free(at, group);
      store_tile<kWidth>(acc, tile_at, at);
      tile_is_written(at, group, tile_at, saves ? p.trunk + piece * (kRows * kWidth) : nullptr, kTileBytes);
    }
    if (p.rgb.empty()) continue;
    float view[kView / 2] = {};
    multiply<kView>(view, tile_at, row_step(kWidth), kWidth / kTerms, ring, true);
    const MaskBits<kView> mask = color(p, view, sh.color, sh.view_bias, row, at.quad);
    if (!saves) continue;
    p.hidden_mask[block * hopper::kWarpgroup + at.thread] = make_uint2(mask.word[0], mask.word[1]);
    tile_is_free(at, group);
    store_tile<kView>(view, tile_at, at);
    tile_is_written(at, group, tile_at, p.hidden + block * (kRows * kView), kRows * kView * 2);
  }
  if (at.thread == 0) hopper::bulk_stores_are_done();
}

[[maybe_unused]] __device__ void run(const Forward& p) {
  extern __shared__ __align__(128) std::byte memory[];
  const Shared sh(memory, p.depth);
  for (int k = static_cast<int>(threadIdx.x); k < p.depth * kWidth; k += kThreads) {
    sh.bias[k] = p.bias[static_cast<std::size_t>(k / kWidth)][k % kWidth];
  }
  for (int k = static_cast<int>(threadIdx.x); k < kWidth; k += kThreads) sh.density[k] = p.density_weight[k];
  for (int k = static_cast<int>(threadIdx.x); k < kChannels * kView; k += kThreads) {
    sh.color[k] = p.color_weight[k % kView * kChannels + k / kView];
  }
  for (int k = static_cast<int>(threadIdx.x); p.view_bias != nullptr && k < kView; k += kThreads) {
    sh.view_bias[k] = p.view_bias[k];
  }
  if (threadIdx.x == 0) {
    sh.ring().init();
    for (int group = 0; group < kGroups; ++group) {
      hopper::barrier_init(sh.position_full(group), 1);
      hopper::barrier_init(sh.position_empty(group), 4);
    }
    hopper::fence_barrier_init();
  }
  __syncthreads();
  if constexpr (kCluster > 1) hopper::cluster_barrier();
  const Tiles tiles(p.blocks);
  const int group = static_cast<int>(threadIdx.x) / hopper::kWarpgroup;
  if (group == kGroups) {
    hopper::fewer_registers<24>();
    if (threadIdx.x % hopper::kWarpgroup == 0) feed(p, sh, tiles);
  } else {
    hopper::more_registers<240>();
    compute(p, sh, tiles, group);
  }
  if constexpr (kCluster > 1) hopper::cluster_barrier();  // a block's memory must last while others copy into it
}

__global__ void __launch_bounds__(kThreads, 1) forward_kernel(const __grid_constant__ Forward p) {
  NV_IF_TARGET(NV_HAS_FEATURE_SM_90a, (run(p);))
}

}  // namespace

void forward(const Forward& call) {
  launch_in_clusters(forward_kernel, call, Shared::bytes(call.depth), call.blocks, "nerf_mlp forward");
}

}  // namespace semfield::cuda::fused
