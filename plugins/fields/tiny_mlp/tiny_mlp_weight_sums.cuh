// Weight gradients of the fused small network: the operands that a block's rows leave in shared memory, the sums that
// each warp owns over all of the block's tiles, where a block writes them, and their sum over blocks.
#pragma once

#include "fields/tiny_mlp/tiny_mlp_partials.cuh"
#include "fields/tiny_mlp/tiny_mlp_tile.cuh"

namespace semfield::cuda::tiny {

inline constexpr int kBackwardThreads = 128;
inline constexpr int kBlockRows = kBackwardThreads / kWarp * kTileRows;
inline constexpr int kPitch = pitch_of(kWidth), kNarrow = pitch_of(kGroup);

/// Operands of the weight gradients for the rows of a block's tile, bf16 in shared memory.
template <int kPositionTiles, int kDirectionTiles>
struct alignas(16) Operands {
  static constexpr int kPosition = pitch_of(kPositionTiles * kGroup);
  static constexpr int kColorIn = pitch_of((1 + kDirectionTiles) * kGroup);
  __nv_bfloat16 position[kBlockRows * kPosition];
  __nv_bfloat16 hidden[kBlockRows * kPitch];
  __nv_bfloat16 color_in[kBlockRows * kColorIn];
  __nv_bfloat16 color_0[kBlockRows * kPitch];
  __nv_bfloat16 color_1[kBlockRows * kPitch];
  __nv_bfloat16 d_hidden[kBlockRows * kPitch];
  __nv_bfloat16 d_geometry[kBlockRows * kNarrow];
  __nv_bfloat16 d_color_0[kBlockRows * kPitch];
  __nv_bfloat16 d_color_1[kBlockRows * kPitch];
  __nv_bfloat16 d_logit[kBlockRows * kRgbPitch];
};
/// The sums of weight gradients that one warp owns, over all tiles of its block. A layer's weight gradient [in, out] is
/// cut into tiles of 16 inputs and 8 outputs: color_1: inputs 32 (warp % 2) .. and outputs 32 (warp / 2) ..; color_0
/// and hidden: all inputs, outputs 16 warp ..; geometry and rgb: inputs 16 warp .., all outputs. Bias gradients are
/// column sums of the same operands: a lane adds the rows it holds.
template <int kPositionTiles, int kDirectionTiles>
struct WarpSums {
  static constexpr int kColorTiles = 1 + kDirectionTiles;
  Sums color_1[2][4], color_0[kColorTiles][2], hidden[kPositionTiles][2], geometry[2], rgb;
  float color_1_bias[2], hidden_bias[2], geometry_bias[2], rgb_bias;

  __device__ void reset() {
#pragma unroll
    for (auto& row : color_1) clear(row);
#pragma unroll
    for (auto& row : color_0) clear(row);
#pragma unroll
    for (auto& row : hidden) clear(row);
    clear(geometry);
    rgb = Sums{};
    color_1_bias[0] = color_1_bias[1] = hidden_bias[0] = hidden_bias[1] = 0;
    geometry_bias[0] = geometry_bias[1] = rgb_bias = 0;
  }

  static __device__ void add(Sums (&sums)[2], const Fragment& x, const Fragment& dz) {
    multiply_add(sums[0], x, dz.reg[0], dz.reg[1]);
    multiply_add(sums[1], x, dz.reg[2], dz.reg[3]);
  }

  using Tile = Operands<kPositionTiles, kDirectionTiles>;
  __device__ void add_color(const Lane& lane, int warp, const Tile& o) {
    const int in_1 = warp % 2 * 32, out_1 = warp / 2 * 32;
#pragma unroll 1
    for (int row = 0; row < kBlockRows; row += kGroup) {
      const Fragment dz[2] = {outputs<kPitch>(lane, o.d_color_1, row, out_1),
                              outputs<kPitch>(lane, o.d_color_1, row, out_1 + kGroup)};
#pragma unroll
      for (int m = 0; m < 2; ++m) {
        const Fragment x = inputs<kPitch>(lane, o.color_0, row, in_1 + m * kGroup);
#pragma unroll
        for (int n = 0; n < 2; ++n) {
          multiply_add(color_1[m][2 * n], x, dz[n].reg[0], dz[n].reg[1]);
          multiply_add(color_1[m][2 * n + 1], x, dz[n].reg[2], dz[n].reg[3]);
        }
      }
      // Warps 0 and 1 hold the same outputs, and so do 2 and 3: each sums 16 of them.
      const Fragment mine = warp % 2 == 0 ? dz[0] : dz[1];
      color_1_bias[0] += column_sum(mine.reg[0], mine.reg[1]);
      color_1_bias[1] += column_sum(mine.reg[2], mine.reg[3]);

      const Fragment dz_0 = outputs<kPitch>(lane, o.d_color_0, row, warp * kGroup);
#pragma unroll
      for (int m = 0; m < kColorTiles; ++m)
        add(color_0[m], inputs<Tile::kColorIn>(lane, o.color_in, row, m * kGroup), dz_0);

      // 16 rows of 8 columns: matrices 2 and 3 repeat 0 and 1.
      const Fragment dz_rgb = load_transposed(o.d_logit + (row + lane.row_8 + lane.low_8) * kRgbPitch);
      multiply_add(rgb, inputs<kPitch>(lane, o.color_1, row, warp * kGroup), dz_rgb.reg[0], dz_rgb.reg[1]);
      rgb_bias += column_sum(dz_rgb.reg[0], dz_rgb.reg[1]);
    }
  }
  __device__ void add_density(const Lane& lane, int warp, const Tile& o) {
#pragma unroll 1
    for (int row = 0; row < kBlockRows; row += kGroup) {
      const Fragment dz = outputs<kPitch>(lane, o.d_hidden, row, warp * kGroup);
#pragma unroll
      for (int m = 0; m < kPositionTiles; ++m)
        add(hidden[m], inputs<Tile::kPosition>(lane, o.position, row, m * kGroup), dz);
      hidden_bias[0] += column_sum(dz.reg[0], dz.reg[1]);
      hidden_bias[1] += column_sum(dz.reg[2], dz.reg[3]);

      const Fragment dz_geometry = outputs<kNarrow>(lane, o.d_geometry, row, 0);
      add(geometry, inputs<kPitch>(lane, o.hidden, row, warp * kGroup), dz_geometry);
      geometry_bias[0] += column_sum(dz_geometry.reg[0], dz_geometry.reg[1]);
      geometry_bias[1] += column_sum(dz_geometry.reg[2], dz_geometry.reg[3]);
    }
  }
};

/// Where the sums of a block lie in its part of the scratch memory, in floats: tiles of 32 lanes x 4 sums, then biases.
template <int kPositionTiles, int kDirectionTiles>
struct Layout {
  static constexpr int kTile = 4 * kWarp;
  static constexpr int kColor1 = 0, kColor0 = kColor1 + 4 * 8 * kTile;
  static constexpr int kHidden = kColor0 + (1 + kDirectionTiles) * 8 * kTile;
  static constexpr int kGeometry = kHidden + kPositionTiles * 8 * kTile, kRgb = kGeometry + 4 * 2 * kTile;
  static constexpr int kColor1Bias = kRgb + 4 * kTile, kHiddenBias = kColor1Bias + kWidth;
  static constexpr int kGeometryBias = kHiddenBias + kWidth, kRgbBias = kGeometryBias + kGroup;
  static constexpr int kSize = kRgbBias + kRgbPitch;
};

template <int kPositionTiles, int kDirectionTiles>
__device__ void write_sums(const WarpSums<kPositionTiles, kDirectionTiles>& sums, const Lane& lane, int lane_number,
                           int warp, float* __restrict__ to) {
  using L = Layout<kPositionTiles, kDirectionTiles>;
  const auto tile = [&](int part, int number, const Sums& s) {
    *reinterpret_cast<float4*>(to + part + number * L::kTile + 4 * lane_number) = {s.value[0], s.value[1], s.value[2],
                                                                                   s.value[3]};
  };
#pragma unroll
  for (int m = 0; m < 2; ++m) {
#pragma unroll
    for (int n = 0; n < 4; ++n) tile(L::kColor1, (warp % 2 * 2 + m) * 8 + warp / 2 * 4 + n, sums.color_1[m][n]);
  }
#pragma unroll
  for (int n = 0; n < 2; ++n) {
#pragma unroll
    for (int m = 0; m < 1 + kDirectionTiles; ++m) tile(L::kColor0, m * 8 + warp * 2 + n, sums.color_0[m][n]);
#pragma unroll
    for (int m = 0; m < kPositionTiles; ++m) tile(L::kHidden, m * 8 + warp * 2 + n, sums.hidden[m][n]);
    tile(L::kGeometry, warp * 2 + n, sums.geometry[n]);
  }
  tile(L::kRgb, warp, sums.rgb);
  // Lanes with the same g hold rows of the same column.
  const auto bias = [&](int at, float sum, bool mine) {
    sum += __shfl_xor_sync(kFullMask, sum, 1);
    sum += __shfl_xor_sync(kFullMask, sum, 2);
    if (mine && lane.q == 0) to[at + lane.g] = sum;
  };
#pragma unroll
  for (int n = 0; n < 2; ++n) {
    bias(L::kColor1Bias + warp / 2 * 32 + warp % 2 * kGroup + n * 8, sums.color_1_bias[n], true);
    bias(L::kHiddenBias + warp * kGroup + n * 8, sums.hidden_bias[n], true);
    bias(L::kGeometryBias + n * 8, sums.geometry_bias[n], warp == 0);
  }
  bias(L::kRgbBias, sums.rgb_bias, warp == 0);
}

/// Adds the blocks' sums, in their order, to the gradients: a column of threads an element of Layout.
template <int kPositionTiles, int kDirectionTiles>
__global__ void __launch_bounds__(kSumColumns* kSumSegments)
    sum_blocks_kernel(const float* __restrict__ partial, int blocks, const NetworkGradient d) {
  using L = Layout<kPositionTiles, kDirectionTiles>;
  const int element = static_cast<int>(blockIdx.x) * kSumColumns + static_cast<int>(threadIdx.x);
  const float sum = sum_of_partials(partial, blocks, L::kSize, element);
  if (threadIdx.y != 0 || element >= L::kSize) return;
  const auto add = [sum](View<float> to, std::int64_t row, int col) {
    if (row >= 0 && row < to.rows && col < to.cols) to(row, col) += sum;
  };
  if (element >= L::kRgbBias) return add(d.rgb_bias, 0, element - L::kRgbBias);
  if (element >= L::kGeometryBias) return add(d.geometry_bias, 0, column_of(element - L::kGeometryBias));
  if (element >= L::kHiddenBias) return add(d.hidden_bias, 0, column_of(element - L::kHiddenBias));
  if (element >= L::kColor1Bias) return add(d.color_1_bias, 0, column_of(element - L::kColor1Bias));
  // Sum i of lane 4 g + q of a tile stands at input position g + 8 (i / 2) and output position 2 q + i % 2.
  const int lane = element % L::kTile / 4, i = element % 4;
  const int in_tile = lane / 4 + 8 * (i / 2), out_tile = 2 * (lane % 4) + i % 2;
  const auto position = [&](int part, int tiles, int& in, int& out) {
    const int number = (element - part) / L::kTile;
    in = number / tiles * kGroup + in_tile;
    out = number % tiles * 8 + out_tile;
  };
  int in = 0, out = 0;
  if (element >= L::kRgb) {
    position(L::kRgb, 1, in, out);
    add(d.rgb, column_of(in), out);
  } else if (element >= L::kGeometry) {
    position(L::kGeometry, 2, in, out);
    add(d.geometry, column_of(in), column_of(out));
  } else if (element >= L::kHidden) {
    position(L::kHidden, 8, in, out);
    add(d.hidden, column_of(in), column_of(out));
  } else if (element >= L::kColor0) {
    position(L::kColor0, 8, in, out);
    if (in == 0) return add(d.color_0_bias, 0, column_of(out));  // the input that is 1
    add(d.color_0, Weights<kPositionTiles, kDirectionTiles>::color_0_row(in, d.geometry.cols - 1), column_of(out));
  } else {
    position(L::kColor1, 8, in, out);
    add(d.color_1, column_of(in), column_of(out));
  }
}

}  // namespace semfield::cuda::tiny
