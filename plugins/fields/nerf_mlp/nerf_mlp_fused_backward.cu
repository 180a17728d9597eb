// Gradients of activations through all layers in one kernel, built as the forward: a warpgroup takes 64 rows from the
// outputs' gradients to the first layer. Per row: read 28 bytes of heads, 1,024 with a feature (in bf16 512), 256 with
// the semantic layer, 32 depth + 16 of masks; written 512 depth + 256. 2 (256^2 (depth - 1) + 256 128) operations a
// row, 2 256 128 more with the semantic layer. The same bits in every run and for every batch.
#include <nv/target>

#include "fields/nerf_mlp/nerf_mlp.h"
#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"

namespace semfield::cuda::fused {

namespace {

constexpr int kStages = 5;

// Shared memory, in this order from its aligned start.
struct Shared {
  std::uint32_t slabs, tiles, barriers;
  float *density, *color;  // [256], [3, 128]
  static constexpr std::uint32_t kFloats = kSlabBytes * kStages + kTileBytes * kGroups;
  static constexpr std::uint32_t kBytes =
      kFloats + (kWidth + kChannels * kView) * 4 + Ring<kStages>::kBarrierBytes + 8 * kGroups;
  __device__ explicit Shared(std::byte* memory) {
    slabs = hopper::shared_address(memory);
    tiles = slabs + kSlabBytes * kStages;
    density = reinterpret_cast<float*>(memory + kFloats);
    color = density + kWidth;
    barriers = hopper::shared_address(color + kChannels * kView);
  }
  __device__ Ring<kStages> ring() const { return {slabs, barriers}; }
  __device__ std::uint32_t semantic_full(int group) const {
    return barriers + Ring<kStages>::kBarrierBytes + 8 * static_cast<std::uint32_t>(group);
  }
};

constexpr std::uint32_t kViewTileBytes = kRows * kView * 2;

// Whether a cluster's tile has rows of the semantic layer.
__device__ inline bool has_semantic(const InputGradient& p, std::int64_t tile) {
  return tile * (kGroups * kCluster) < p.semantic_blocks;
}

// Slabs: of the semantic layer, of the view layer, of the trunk from its end.
__device__ void feed(const InputGradient& p, const Shared& sh, const Tiles& tiles) {
  Ring<kStages> ring = sh.ring();
  constexpr int kOfView = kView / kTerms;
  const int slabs = (p.d_rgb.empty() ? 0 : kOfView) + (p.depth - 1) * (kWidth / kTerms);
  for (std::int64_t tile = tiles.first; tile < tiles.count; tile += tiles.step) {
    const std::byte* from = p.weights;
    if (has_semantic(p, tile)) {
      for (int s = 0; s < kOfView; ++s) ring.feed(from + s * kSlabBytes, kSlabBytes, tiles.rank);
    }
    if (p.semantic_blocks > 0) from += kOfView * kSlabBytes;
    for (int s = 0; s < slabs; ++s, from += kSlabBytes) ring.feed(from, kSlabBytes, tiles.rank);
  }
}

// dL/d(view layer) of a thread's numbers.
__device__ inline void from_color(const InputGradient& p, float (&acc)[kView / 2], const float* weight,
                                  std::int64_t row, int quad) {
  float d_logit[2][kChannels];
#pragma unroll
  for (int half = 0; half < 2; ++half) {
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      const std::int64_t at = row + 8 * half;
      d_logit[half][c] = at < p.rows ? p.d_rgb(at, c) * sigmoid_slope(p.rgb(at, c)) : 0;
    }
  }
#pragma unroll
  for (int j = 0; j < kView / 8; ++j) {
    float sum[4] = {0, 0, 0, 0};
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      const float2 w = *reinterpret_cast<const float2*>(weight + c * kView + 8 * j + 2 * quad);
#pragma unroll
      for (int e = 0; e < 4; ++e) sum[e] = fmaf(d_logit[e / 2][c], e % 2 == 0 ? w.x : w.y, sum[e]);
    }
#pragma unroll
    for (int e = 0; e < 4; ++e) acc[4 * j + e] = sum[e];
  }
}

// acc += d_feature + d_sigma w^T.
__device__ inline void add_heads(const InputGradient& p, float (&acc)[kWidth / 2], const float* weight,
                                 std::int64_t row, int quad) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t at = row + 8 * half;
    if (at >= p.rows) continue;
    if (at < p.d_rounded_feature.rows) {
      const __nv_bfloat16* from = p.d_rounded_feature.row(at) + 2 * quad;
#pragma unroll
      for (int j = 0; j < kWidth / 8; ++j) {
        const float2 d = __bfloat1622float2(*reinterpret_cast<const __nv_bfloat162*>(from + 8 * j));
        acc[4 * j + 2 * half] += d.x;
        acc[4 * j + 2 * half + 1] += d.y;
      }
    } else if (!p.d_feature.empty()) {
      const float* from = p.d_feature.row(at) + 2 * quad;
#pragma unroll
      for (int j = 0; j < kWidth / 8; ++j) {
        const float2 d = *reinterpret_cast<const float2*>(from + 8 * j);
        acc[4 * j + 2 * half] += d.x;
        acc[4 * j + 2 * half + 1] += d.y;
      }
    }
    if (p.d_sigma.empty()) continue;
    const float d_sigma = p.d_sigma(at, 0);
#pragma unroll
    for (int j = 0; j < kWidth / 8; ++j) {
      const float2 w = *reinterpret_cast<const float2*>(weight + 8 * j + 2 * quad);
      acc[4 * j + 2 * half] = fmaf(d_sigma, w.x, acc[4 * j + 2 * half]);
      acc[4 * j + 2 * half + 1] = fmaf(d_sigma, w.y, acc[4 * j + 2 * half + 1]);
    }
  }
}

__device__ void compute(const InputGradient& p, const Shared& sh, const Tiles& tiles, int group) {
  const Lane at;
  Ring<kStages> ring = sh.ring();
  const std::uint32_t tile_at = sh.tiles + static_cast<std::uint32_t>(group) * kTileBytes;
  const Rows of_view{tile_at, row_step(kView), kView}, above{tile_at, row_step(kWidth), kWidth};
  const Rows of_semantic{tile_at + kViewTileBytes, row_step(kView), kView};
  std::uint32_t turn = 0;
  for (std::int64_t tile = tiles.first; tile < tiles.count; tile += tiles.step) {
    const std::int64_t block = tiles.block(tile, group);
    const std::int64_t row = block * kRows + at.row;
    float acc[kWidth / 2] = {};  // defined, so that no registers are kept for it across tiles
    const bool with_semantic = has_semantic(p, tile);
    if (with_semantic) {
      tile_is_free(at, group);
      if (at.thread == 0) {
        hopper::barrier_expect(sh.semantic_full(group), kViewTileBytes);
        hopper::bulk_load(of_semantic.address, p.d_semantic + block * (kRows * kView), kViewTileBytes,
                          sh.semantic_full(group));
      }
    }
    if (!p.d_rgb.empty()) {
      float view[kView / 2];
      const uint2 bits = p.hidden_mask[block * hopper::kWarpgroup + at.thread];
      const MaskBits<kView> mask{{bits.x, bits.y}};
      from_color(p, view, sh.color, row, at.quad);
      if (!with_semantic) tile_is_free(at, group);
      store_tile<kView>(tile_at, at,
                        [&](int pair) { return mask.apply(pair, hopper::pack(view[2 * pair], view[2 * pair + 1])); });
      tile_is_written(at, group, tile_at, p.d_hidden + block * (kRows * kView), kRows * kView * 2);
    }
    for (int i = p.depth - 1; i >= 0; --i) {
      const std::int64_t piece = i * p.blocks + block;
      const uint4 bits = p.trunk_mask[piece * hopper::kWarpgroup + at.thread];
      if (i < p.depth - 1) {
        multiply<kWidth>(acc, above, true, ring);
      } else {
        if (with_semantic) {
          hopper::barrier_wait(sh.semantic_full(group), turn++ % 2);
          multiply<kWidth>(acc, of_semantic, true, ring);
        }
        if (!p.d_rgb.empty()) multiply<kWidth>(acc, of_view, !with_semantic, ring);
        add_heads(p, acc, sh.density, row, at.quad);
      }
      const MaskBits<kWidth> mask{{bits.x, bits.y, bits.z, bits.w}};
      tile_is_free(at, group);
      store_tile<kWidth>(tile_at, at,
                         [&](int pair) { return mask.apply(pair, hopper::pack(acc[2 * pair], acc[2 * pair + 1])); });
      tile_is_written(at, group, tile_at, p.d_trunk + piece * (kRows * kWidth), kTileBytes);
    }
  }
  if (at.thread == 0) hopper::bulk_stores_are_done();
}

[[maybe_unused]] __device__ void run(const InputGradient& p) {
  extern __shared__ __align__(128) std::byte memory[];
  const Shared sh(memory);
  fill_shared(sh.density, kWidth, [&](int k) { return p.density_weight[k]; });
  fill_shared(sh.color, kChannels * kView, [&](int k) { return p.color_weight[k % kView * kChannels + k / kView]; });
  const auto init = [&] {
    sh.ring().init();
    for (int group = 0; group < kGroups; ++group) hopper::barrier_init(sh.semantic_full(group), 1);
  };
  run_warpgroups(
      p.blocks, init, [&](const Tiles& tiles) { feed(p, sh, tiles); },
      [&](const Tiles& tiles, int group) { compute(p, sh, tiles, group); });
}

__global__ void __launch_bounds__(kThreads, 1) input_gradient_kernel(const __grid_constant__ InputGradient p) {
  NV_IF_TARGET(NV_HAS_FEATURE_SM_90a, (run(p);))
}

}  // namespace

void input_gradient(const InputGradient& call) {
  launch_in_clusters(input_gradient_kernel, call, Shared::kBytes, call.blocks, "nerf_mlp gradients of activations");
}

}  // namespace semfield::cuda::fused
