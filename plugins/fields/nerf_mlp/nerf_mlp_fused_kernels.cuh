// Calls of the fused kernels. All matrices are device memory; "blocked" as nerf_mlp_fused.cuh says. Rows are padded to
// whole tiles: `blocks` counts pieces of 64 rows, rows from `rows` on are computed and shown to nobody.
#pragma once

#include <cuda_bf16.h>

#include <array>
#include <cstdint>

#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda::fused {

inline constexpr int kMostLayers = 15;

struct Forward {
  std::int64_t rows = 0, blocks = 0;
  int depth = 0, skip_at = 0;
  const std::byte* weights = nullptr;       ///< slabs in the order of use; last of view and semantic layer, beside
  const __nv_bfloat16* position = nullptr;  ///< blocked [64 blocks, 64]
  std::array<const float*, kMostLayers> bias{};
  const float *density_weight = nullptr, *density_bias = nullptr;
  const float *color_weight = nullptr, *color_bias = nullptr;  ///< [128, 3], [3]
  const float* view_bias = nullptr;                            ///< without a direction
  View<const float> ray_term;                                  ///< [R, 128], with a direction
  View<const std::int32_t> ray_of_sample;
  /// Null: nothing is saved. Blocked [depth][64 blocks, 256], [64 blocks, 128]; bits as MaskBits of every thread of a
  /// piece's warpgroup: [depth][blocks][128] of 16 bytes, [blocks][128] of 8.
  __nv_bfloat16 *trunk = nullptr, *hidden = nullptr;
  uint4* trunk_mask = nullptr;
  uint2* hidden_mask = nullptr;
  View<float> sigma, rgb, feature;      ///< empty: not wanted
  View<__nv_bfloat16> rounded_feature;  ///< rows in bf16
  /// [N <= rows, 128]: relu(feature W + b) of the first rows, with rgb; empty: not wanted.
  View<__nv_bfloat16> semantic;
  const float* semantic_bias = nullptr;
};
void forward(const Forward& call);

struct InputGradient {
  std::int64_t rows = 0, blocks = 0;
  int depth = 0;
  const std::byte* weights = nullptr;  ///< slabs in the order of use
  const float *density_weight = nullptr, *color_weight = nullptr;
  const uint4* trunk_mask = nullptr;
  const uint2* hidden_mask = nullptr;
  View<const float> rgb, d_rgb, d_sigma, d_feature;  ///< gradients may be empty
  View<const __nv_bfloat16> d_rounded_feature;       ///< instead of d_feature; rows behind its last count as 0
  /// Or dL/d(semantic layer before its ReLU), blocked [64 semantic_blocks, 128] of whole tiles; rows behind count as 0.
  const __nv_bfloat16* d_semantic = nullptr;
  std::int64_t semantic_blocks = 0;
  /// dL/d(layer before its ReLU), blocked [depth][64 blocks, 256] and, with d_rgb, [64 blocks, 128].
  __nv_bfloat16 *d_trunk = nullptr, *d_hidden = nullptr;
};
void input_gradient(const InputGradient& call);

/// d_weight (and d_bias) += A^T B over all rows. A blocked [64 blocks, 256 or 64], B blocked [64 blocks, 256 or 128].
struct WeightGradient {
  const __nv_bfloat16 *a = nullptr, *b = nullptr;
  int a_cols = 0, b_cols = 0;
  View<float> d_weight;     ///< [at most a_cols, b_cols]
  View<float> d_bias;       ///< [1, b_cols] or empty: column sums of B
  std::int64_t blocks = 0;  ///< as WeightGradients::blocks
};
inline constexpr int kMostGradients = kMostLayers + 3;
struct WeightGradients {
  std::array<WeightGradient, kMostGradients> all;
  int count = 0;
};
/// One launch for all, and one that adds the blocks' parts in order.
void weight_gradients(const WeightGradients& call, Workspace& arena);

/// Slabs of weights: [terms / 8][columns / 8][8 columns][8 terms] of bf16 for 64 terms each. An element is weight(term,
/// column), or weight(column, term) with `transposed`; terms beyond the matrix are 0. beside, without `transposed`: a
/// matrix whose columns follow those of the weight.
struct Slabs {
  View<const float> weight;
  bool transposed = false;
  int columns = 0, slabs = 0;
  View<const float> beside = {};
};
inline constexpr int kMostSlabs = kMostLayers + 3;
/// Packs all one behind the other; returns what they take in bytes.
std::size_t slab_bytes(const std::array<Slabs, kMostSlabs>& all, int count);
void pack_slabs(const std::array<Slabs, kMostSlabs>& all, int count, std::byte* to);

/// blocked [64 blocks, 64] = position [M, at most 64], padding 0.
void pack_position(View<const float> position, std::int64_t blocks, __nv_bfloat16* blocked);
/// rows [M, cols] of a blocked matrix in fp32.
void unpack(const __nv_bfloat16* blocked, View<float> rows);
/// d_ray_term [R, 128] = sums of blocked d_hidden over each ray's samples in use.
void per_ray_sums(const __nv_bfloat16* d_hidden, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);

/// d_weight, d_bias += X^T g, column sums of g; X blocked; g = d, or d y (1 - y) with y given. Weights and biases are
/// whole tensors.
struct HeadGradient {
  const __nv_bfloat16* x = nullptr;
  View<const float> d, y;  ///< d empty: nothing is added
  View<float> d_weight, d_bias;
};
/// density: X [64 blocks, 256], d_weight [256, 1]; color: X [64 blocks, 128], d_weight [128, 3].
void head_gradients(const HeadGradient& density, const HeadGradient& color, Workspace& arena);

}  // namespace semfield::cuda::fused
