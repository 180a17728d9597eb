// Forward through all layers in one kernel. A warpgroup: 64 rows, 64 x 256 sums in registers; the layer's input is read
// from shared memory, its output goes there (and to memory when a backward follows). Weights stream through a ring that
// one thread of the third warpgroup fills. Per row: 128 bytes of position read; written with a backward 512 depth + 256
// + 32 depth + 16, with a feature 1,024 (in bf16 512), the semantic layer 256, colour and density 16; weights come from
// the second-level cache, 1 MB for every 256 rows. 2 (64 256 2 + 256^2 (depth - 1) + 256 128) operations per row, 2 256
// 128 more with the semantic layer; padding of the position included.
// Results are the same bits in every run and for every batch.
#include <nv/target>

#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"

namespace semfield::cuda::fused {

namespace {

using hopper::barrier_wait;

constexpr int kStages = 4;

// Shared memory, in this order from its aligned start.
struct Shared {
  std::uint32_t slabs, tiles, positions, barriers;
  float *bias, *density, *color, *view_bias, *semantic_bias;  // [depth, 256], [256], [3, 128], [128], [128]
  static constexpr std::uint32_t kFloats = kSlabBytes * kStages + (kTileBytes + kPositionBytes) * kGroups;
  static constexpr std::uint32_t kBarrierBytes = Ring<kStages>::kBarrierBytes + 16 * kGroups;
  static constexpr std::uint32_t bytes(int depth) {
    return kFloats + static_cast<std::uint32_t>(depth * kWidth + kWidth + (kChannels + 2) * kView) * 4 + kBarrierBytes;
  }
  __device__ Shared(std::byte* memory, int depth) {
    slabs = hopper::shared_address(memory);
    tiles = slabs + kSlabBytes * kStages;
    positions = tiles + kTileBytes * kGroups;
    bias = reinterpret_cast<float*>(memory + kFloats);
    density = bias + depth * kWidth;
    color = density + kWidth;
    view_bias = color + kChannels * kView;
    semantic_bias = view_bias + kView;
    barriers = hopper::shared_address(semantic_bias + kView);
  }
  __device__ Ring<kStages> ring() const { return {slabs, barriers}; }
  __device__ std::uint32_t position_full(int group) const {
    return barriers + Ring<kStages>::kBarrierBytes + 16 * static_cast<std::uint32_t>(group);
  }
  __device__ std::uint32_t position_empty(int group) const { return position_full(group) + 8; }
};

__device__ void feed(const Forward& p, const Shared& sh, const Tiles& tiles) {
  Ring<kStages> ring = sh.ring();
  const int trunk_slabs = (p.depth - 1) * (kWidth / kTerms) + (p.skip_at > 0 ? 2 : 1) * (kPosition / kTerms);
  // View and semantic layer are one product of 256 columns.
  const int view_slabs = p.rgb.empty() ? 0 : kWidth / kTerms;
  const std::uint32_t view_bytes = p.semantic.empty() ? kViewSlabBytes : kSlabBytes;
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
    for (int s = 0; s < view_slabs; ++s, from += view_bytes) ring.feed(from, view_bytes, tiles.rank);
  }
}

__device__ inline float2 pair_of(const float* row, int j, int quad) {
  return *reinterpret_cast<const float2*>(row + 8 * j + 2 * quad);
}

// From the last layer before its bias and ReLU.
__device__ inline void density_and_feature(const Forward& p, const float (&acc)[kWidth / 2], const float* bias,
                                           const float* weight, std::int64_t row, int quad) {
  const auto h = [&](int j, int e) {
    const float2 b = pair_of(bias, j, quad);
    const float value = acc[4 * j + e] + (e % 2 == 0 ? b.x : b.y);
    return value < 0 ? 0.0F : value;  // NaN stays NaN
  };
  if (!p.sigma.empty()) {
    float sum[2] = {0, 0};
#pragma unroll
    for (int j = 0; j < kWidth / 8; ++j) {
      const float2 w = pair_of(weight, j, quad);
      sum[0] = fmaf(h(j, 1), w.y, fmaf(h(j, 0), w.x, sum[0]));
      sum[1] = fmaf(h(j, 3), w.y, fmaf(h(j, 2), w.x, sum[1]));
    }
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const float total = row_sum(sum[half]);
      if (quad == 0 && row + 8 * half < p.rows) p.sigma(row + 8 * half, 0) = total + p.density_bias[0];
    }
  }
  if (p.feature.empty()) return;
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    if (row + 8 * half >= p.rows) continue;
    float* to = p.feature.row(row + 8 * half) + 2 * quad;
#pragma unroll
    for (int j = 0; j < kWidth / 8; ++j) {
      *reinterpret_cast<float2*>(to + 8 * j) = make_float2(h(j, 2 * half), h(j, 2 * half + 1));
    }
  }
}

// A tile to rows of memory: a warp moves 8 rows of 64 bytes at a time.
template <int kColumns>
__device__ inline void copy_rows(std::uint32_t tile, const View<__nv_bfloat16>& to, std::int64_t first_row,
                                 const Lane& at) {
  constexpr int kMoves = kColumns / 32;  // of 8 rows
#pragma unroll 2
  for (int i = at.warp; i < kRows / 8 * kMoves; i += 4) {
    const int rows_of_8 = i / kMoves, col_block = i % kMoves * 4 + at.lane / 8, in_block = at.lane % 8;
    const std::uint32_t from = tile + static_cast<std::uint32_t>(rows_of_8) * row_step(kColumns) +
                               static_cast<std::uint32_t>(col_block) * kBlockBytes +
                               static_cast<std::uint32_t>(in_block) * 16;
    const std::int64_t row = first_row + rows_of_8 * 8 + in_block;
    if (row >= to.rows) continue;
    reinterpret_cast<uint4*>(to.row(row))[col_block] = hopper::load_shared(from);
  }
}

// The view layer's ReLU in place, with the ray's part, and the colour.
__device__ inline void color(const Forward& p, float (&acc)[kView / 2], const float* weight, const float* view_bias,
                             std::int64_t row, int quad) {
  const float* term[2] = {view_bias, view_bias};
  if (!p.ray_term.empty()) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const std::int64_t sample = row + 8 * half < p.rows ? row + 8 * half : p.rows - 1;
      term[half] = p.ray_term.row(p.ray_of_sample(sample, 0));
    }
  }
  float sum[2][kChannels] = {};
#pragma unroll
  for (int j = 0; j < kView / 8; ++j) {
    const float2 first = *reinterpret_cast<const float2*>(term[0] + 8 * j + 2 * quad);
    const float2 second = *reinterpret_cast<const float2*>(term[1] + 8 * j + 2 * quad);
    const float of[4] = {first.x, first.y, second.x, second.y};
#pragma unroll
    for (int e = 0; e < 4; ++e) {
      const float value = acc[4 * j + e] + of[e];
      acc[4 * j + e] = value < 0 ? 0.0F : value;  // NaN stays NaN
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
}

__device__ void compute(const Forward& p, const Shared& sh, const Tiles& tiles, int group) {
  const Lane at;
  Ring<kStages> ring = sh.ring();
  const std::uint32_t tile_at = sh.tiles + static_cast<std::uint32_t>(group) * kTileBytes;
  const Rows below{tile_at, row_step(kWidth), kWidth};
  const Rows position{sh.positions + static_cast<std::uint32_t>(group) * kPositionBytes, row_step(kPosition),
                      kPosition};
  const bool saves = p.trunk != nullptr;
  std::uint32_t turn = 0;
  for (std::int64_t tile = tiles.first; tile < tiles.count; tile += tiles.step, ++turn) {
    const std::int64_t block = tiles.block(tile, group);
    const std::int64_t row = block * kRows + at.row;
    float acc[kWidth / 2] = {};  // defined, so that no registers are kept for it across tiles
    barrier_wait(sh.position_full(group), turn % 2);
    for (int i = 0; i < p.depth; ++i) {
      const float* const bias = sh.bias + i * kWidth;
      const bool reads_position = i == 0 || i == p.skip_at;
      if (reads_position) multiply<kWidth>(acc, position, true, ring);
      if (i > 0) multiply<kWidth>(acc, below, !reads_position, ring);
      if (i == p.skip_at && at.lane == 0) hopper::barrier_arrive(sh.position_empty(group));
      const bool is_last = i == p.depth - 1;
      if (is_last) density_and_feature(p, acc, bias, sh.density, row, at.quad);
      MaskBits<kWidth> mask{};
      tile_is_free(at, group);
      store_tile<kWidth>(tile_at, at, [&](int pair) {
        const float2 b = pair_of(bias, pair / 2, at.quad);
        const std::uint32_t packed = hopper::pack_positive(acc[2 * pair] + b.x, acc[2 * pair + 1] + b.y);
        mask.add(pair, packed);
        return packed;
      });
      const std::int64_t piece = i * p.blocks + block;
      tile_is_written(at, group, tile_at, saves ? p.trunk + piece * (kRows * kWidth) : nullptr, kTileBytes);
      if (saves) {
        p.trunk_mask[piece * hopper::kWarpgroup + at.thread] =
            make_uint4(mask.word[0], mask.word[1], mask.word[2], mask.word[3]);
      }
      if (is_last && !p.rounded_feature.empty()) copy_rows<kWidth>(tile_at, p.rounded_feature, block * kRows, at);
    }
    if (p.rgb.empty()) continue;
    // Columns 0 to 127 are the view layer's, the others the semantic layer's.
    float(&view)[kView / 2] = *reinterpret_cast<float(*)[kView / 2]>(&acc[0]);
    const float* const semantic = acc + kView / 2;
    if (p.semantic.empty()) {
      multiply<kView>(view, below, true, ring);
    } else {
      multiply<kWidth>(acc, below, true, ring);
    }
    color(p, view, sh.color, sh.view_bias, row, at.quad);
    const bool with_semantic = block * kRows < p.semantic.rows;
    if (!saves && !with_semantic) continue;
    const std::uint32_t semantic_at = tile_at + kRows * kView * 2;  // the tile's second half
    tile_is_free(at, group);
    if (saves) {
      MaskBits<kView> mask{};
      store_tile<kView>(tile_at, at, [&](int pair) {
        const std::uint32_t packed = hopper::pack_positive(view[2 * pair], view[2 * pair + 1]);
        mask.add(pair, packed);
        return packed;
      });
      p.hidden_mask[block * hopper::kWarpgroup + at.thread] = make_uint2(mask.word[0], mask.word[1]);
    }
    if (with_semantic) {
      store_tile<kView>(semantic_at, at, [&](int pair) {
        const float2 b = pair_of(sh.semantic_bias, pair / 2, at.quad);
        return hopper::pack_positive(semantic[2 * pair] + b.x, semantic[2 * pair + 1] + b.y);
      });
    }
    tile_is_written(at, group, tile_at, saves ? p.hidden + block * (kRows * kView) : nullptr, kRows * kView * 2);
    if (with_semantic) copy_rows<kView>(semantic_at, p.semantic, block * kRows, at);
  }
  if (at.thread == 0) hopper::bulk_stores_are_done();
}

[[maybe_unused]] __device__ void run(const Forward& p) {
  extern __shared__ __align__(128) std::byte memory[];
  const Shared sh(memory, p.depth);
  fill_shared(sh.bias, p.depth * kWidth,
              [&](int k) { return p.bias[static_cast<std::size_t>(k / kWidth)][k % kWidth]; });
  fill_shared(sh.density, kWidth, [&](int k) { return p.density_weight[k]; });
  fill_shared(sh.color, kChannels * kView, [&](int k) { return p.color_weight[k % kView * kChannels + k / kView]; });
  if (p.view_bias != nullptr) fill_shared(sh.view_bias, kView, [&](int k) { return p.view_bias[k]; });
  if (!p.semantic.empty()) fill_shared(sh.semantic_bias, kView, [&](int k) { return p.semantic_bias[k]; });
  const auto init = [&] {
    sh.ring().init();
    for (int group = 0; group < kGroups; ++group) {
      hopper::barrier_init(sh.position_full(group), 1);
      hopper::barrier_init(sh.position_empty(group), 4);
    }
  };
  run_warpgroups(
      p.blocks, init, [&](const Tiles& tiles) { feed(p, sh, tiles); },
      [&](const Tiles& tiles, int group) { compute(p, sh, tiles, group); });
}

__global__ void __launch_bounds__(kThreads, 1) forward_kernel(const __grid_constant__ Forward p) {
  NV_IF_TARGET(NV_HAS_FEATURE_SM_90a, (run(p);))
}

}  // namespace

void forward(const Forward& call) {
  launch_in_clusters(forward_kernel, call, Shared::bytes(call.depth), call.blocks, "nerf_mlp forward");
}

}  // namespace semfield::cuda::fused
