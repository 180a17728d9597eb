// Backward of the fused small network: activations again, gradients of a tile's rows in registers, weight gradients of
// a block's tiles in registers too.
#include <algorithm>

#include "cuda/matmul.h"
#include "fields/tiny_mlp/tiny_mlp.h"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"

namespace semfield::cuda::tiny {

namespace {

constexpr int kResident = 2;  // blocks of a multiprocessor: 65,536 registers / (128 . 255)

struct Gradients {
  FieldGrad<float> of;
  View<const __nv_bfloat16> shared_feature;  ///< in place of of.feature: its first rows, the others are 0
  View<const float> rgb;
  View<float> d_position;
  bool vector_feature = false, vector_position = false;
};

template <int kPositionTiles, int kDirectionTiles>
struct alignas(16) Memory {
  Weights<kPositionTiles, kDirectionTiles> weights;
  Operands<kPositionTiles, kDirectionTiles> operands;
};

/// Rows g and g + 8 of a warp's 16 rows, which start at `to`.
template <int kRowPitch, int kGroups>
__device__ inline void store_rows(const Lane& lane, const Fragment (&a)[kGroups], __nv_bfloat16* to) {
#pragma unroll
  for (int k = 0; k < kGroups; ++k) {
    auto* at = reinterpret_cast<std::uint32_t*>(to + lane.g * kRowPitch + k * kGroup + 2 * lane.q);
    at[0] = a[k].reg[0];
    at[4 * kRowPitch] = a[k].reg[1];
    at[4] = a[k].reg[2];
    at[4 * kRowPitch + 4] = a[k].reg[3];
  }
}

/// dL/d(logit) of a lane's rows, packed: lane q = 0 has columns 0 and 1, lane 1 column 2.
__device__ inline void logit_gradient(const Gradients& grad, const Lane& lane, std::int64_t row0, std::int64_t rows,
                                      std::uint32_t (&dz)[2]) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
    float z[2] = {};
    if (row < rows && lane.q < 2) {
#pragma unroll
      for (int i = 0; i < 2; ++i) {
        const int channel = 2 * lane.q + i;
        if (channel < 3) z[i] = grad.of.rgb(row, channel) * sigmoid_slope(grad.rgb(row, channel));
      }
    }
    dz[half] = pack(z[0], z[1]);
  }
}

/// dL/d(h) of a lane's rows before the product with the geometry layer: what came back through the feature. What came
/// in bf16 stays packed until finish_hidden_gradient, so that nothing waits for it here: group k in dh[k].
__device__ inline void start_hidden_gradient(const Gradients& grad, bool hidden_feature, const Lane& lane,
                                             std::int64_t row0, std::int64_t rows, Sums (&dh)[8]) {
  clear(dh);
  const bool shared = !grad.shared_feature.empty();
  if (!hidden_feature || (grad.of.feature.empty() && !shared)) return;
  if (!shared) return load_rows<4>(lane, grad.of.feature, row0, rows, grad.vector_feature, dh);
#pragma unroll
  for (int k = 0; k < 4; ++k) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const std::int64_t row = row0 + lane.g + 8 * half;
      const int col = k * kGroup + 4 * lane.q;
      if (row >= rows || row >= grad.shared_feature.rows || col >= grad.shared_feature.cols) continue;
      const float2 packed = *reinterpret_cast<const float2*>(grad.shared_feature.row(row) + col);
      dh[k].value[half] = packed.x;
      dh[k].value[2 + half] = packed.y;
    }
  }
}
__device__ inline void finish_hidden_gradient(const Gradients& grad, Sums (&dh)[8]) {
  if (grad.shared_feature.empty()) return;
#pragma unroll
  for (int k = 3; k >= 0; --k) {  // group k is read before its place is written
    const Sums packed = dh[k];
#pragma unroll
    for (int i = 0; i < 4; ++i) {  // row half i % 2, columns 2 (i / 2) and the next of the lane's four
      const float2 d = __bfloat1622float2(*reinterpret_cast<const __nv_bfloat162*>(&packed.value[i]));
      dh[2 * k + i / 2].value[2 * (i % 2)] = d.x;
      dh[2 * k + i / 2].value[2 * (i % 2) + 1] = d.y;
    }
  }
}

/// dL/d[sigma, geometry features]: what came through colour, the feature and sigma.
__device__ inline void add_geometry_gradient(const Gradients& grad, bool hidden_feature, const Lane& lane,
                                             std::int64_t row0, std::int64_t rows, Sums (&dg)[2]) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
    const bool used = row < rows;
    if (used && !grad.of.feature.empty() && !hidden_feature) {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const int feature = 4 * lane.q + i - 1;
        if (feature >= 0 && feature < grad.of.feature.cols)
          dg[i / 2].value[2 * half + i % 2] += grad.of.feature(row, feature);
      }
    }
    if (lane.q == 0) dg[0].value[2 * half] = used && !grad.of.sigma.empty() ? grad.of.sigma(row, 0) : 0.0f;
  }
}

/// A block takes 64 rows at a time. First each warp takes 16 of them through the network and back, as forward does, and
/// leaves in shared memory what weight gradients read; then each warp adds all 64 rows to the tiles of weight gradients
/// that it owns. At the end the block writes its sums. A row moves 4 D + 4 + 4 F + 4 + 24 bytes in, 2 F where the
/// feature's gradient comes in bf16, and 4 D out (D = 32, F = 64: 544 bytes, 416 with bf16), and takes 2 . (9,216 again
/// + 8,704 back + 9,728 weight gradients) operations (with a direction, padding included). Rows go to blocks by number
/// alone: same bits in every run.
template <int kPositionTiles, int kDirectionTiles>
__global__ void __launch_bounds__(kBackwardThreads, kResident)
    backward_kernel(const FusedCall call, const Gradients grad, float* __restrict__ partial) {
  extern __shared__ __align__(16) unsigned char shared_memory[];
  auto& memory = *reinterpret_cast<Memory<kPositionTiles, kDirectionTiles>*>(shared_memory);
  const auto& weights = memory.weights;
  using Tile = Operands<kPositionTiles, kDirectionTiles>;
  Tile& o = memory.operands;
  memory.weights.load(call.network);
  __syncthreads();
  const int lane_number = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const Lane lane(lane_number);
  const std::int64_t all = call.in.position.rows, rows = live_count(call.live, all);
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kBlockRows;
  const bool with_color = !grad.of.rgb.empty();
  const int first = warp * kTileRows;  // of this warp within the tile

  WarpSums<kPositionTiles, kDirectionTiles> sums;
  sums.reset();
  std::int64_t block_row = static_cast<std::int64_t>(blockIdx.x) * kBlockRows;
  Inputs<kPositionTiles, kDirectionTiles> inputs;
  inputs.load(call.in, lane, block_row + first, rows, call.vector_position);
  for (; block_row < rows; block_row += stride) {
    const std::int64_t row0 = block_row + first;
    Fragment h[4];
    Sums geometry[2];
    {
      Fragment x[kPositionTiles];
      inputs.pack_position(x);
      store_rows<Tile::kPosition>(lane, x, o.position + first * Tile::kPosition);
      Sums y[8];
      weights.hidden_layer(lane, x, y);
      pack_all(y, h);
      store_rows<kPitch>(lane, h, o.hidden + first * kPitch);
    }
    Sums dg[2], dh[8];
    clear(dg);
    if (with_color) {
      weights.geometry_layer(lane, h, geometry);
      Fragment c0[4], c1[4], dz[4];
      std::uint32_t d_logit[2];
      logit_gradient(grad, lane, row0, rows, d_logit);
      {
        Fragment in[1 + kDirectionTiles];
        inputs.color_input(call.in, lane, call.vector_direction, geometry, in);
        store_rows<Tile::kColorIn>(lane, in, o.color_in + first * Tile::kColorIn);
        Sums y[8];
        weights.color_0_layer(lane, in, y);
        pack_all(y, c0);
        store_rows<kPitch>(lane, c0, o.color_0 + first * kPitch);
      }
      {
        Sums y[8];
        weights.color_1_layer(lane, c0, y);
        pack_all(y, c1);
        store_rows<kPitch>(lane, c1, o.color_1 + first * kPitch);
      }
      {
        auto* to = reinterpret_cast<std::uint32_t*>(o.d_logit + (first + lane.g) * kRgbPitch + 2 * lane.q);
        to[0] = d_logit[0];
        to[4 * kRgbPitch] = d_logit[1];
        Sums dy[8];
        clear(dy);
#pragma unroll
        for (int n = 0; n < 8; n += 4) {
          const Fragment b = load_matrices(weights.rgb + (n * 8 + lane.row_16) * kRgbPitch);
#pragma unroll
          for (int i = 0; i < 4; ++i) multiply_add(dy[n + i], d_logit[0], d_logit[1], b.reg[i]);
        }
        mask_and_pack(dy, c1, dz);
        store_rows<kPitch>(lane, dz, o.d_color_1 + first * kPitch);
      }
      start_hidden_gradient(grad, call.hidden_feature, lane, row0, rows, dh);  // arrives during the products
      {
        Sums dy[8];
        clear(dy);
        backward_product<kPitch>(lane, dz, weights.color_1, dy);
        mask_and_pack(dy, c0, dz);
        store_rows<kPitch>(lane, dz, o.d_color_0 + first * kPitch);
      }
      backward_product<kPitch>(lane, dz, weights.color_0, dg);
    } else {
      start_hidden_gradient(grad, call.hidden_feature, lane, row0, rows, dh);
    }
    add_geometry_gradient(grad, call.hidden_feature, lane, row0, rows, dg);
    {
      const Fragment dz_geometry[1] = {pack(dg[0], dg[1])};
      store_rows<kNarrow>(lane, dz_geometry, o.d_geometry + first * kNarrow);
      finish_hidden_gradient(grad, dh);
      backward_product<kNarrow>(lane, dz_geometry, weights.geometry, dh);
      Fragment dz[4];
      mask_and_pack(dh, h, dz);
      store_rows<kPitch>(lane, dz, o.d_hidden + first * kPitch);
      if (!grad.d_position.empty()) {
        Sums dx[2 * kPositionTiles];
        clear(dx);
        backward_product<kPitch>(lane, dz, weights.hidden, dx);
        store_rows<kPositionTiles>(lane, dx, row0, all, grad.vector_position, grad.d_position);
      }
    }
    inputs.load(call.in, lane, row0 + stride, rows, call.vector_position);  // on their way meanwhile
    __syncthreads();
    if (with_color) sums.add_color(lane, warp, o);
    sums.add_density(lane, warp, o);
    __syncthreads();
  }
  write_sums(sums, lane, lane_number, warp,
             partial + static_cast<std::int64_t>(blockIdx.x) * Layout<kPositionTiles, kDirectionTiles>::kSize);

  if (grad.d_position.empty()) return;
  for (; block_row < all; block_row += stride) {
    const std::int64_t end = block_row + kBlockRows < all ? block_row + kBlockRows : all;
    const std::int32_t cols = grad.d_position.cols;
    for (std::int64_t i = block_row * cols + threadIdx.x; i < end * cols; i += kBackwardThreads)
      grad.d_position(i / cols, static_cast<std::int32_t>(i % cols)) = 0;
  }
}

}  // namespace

void fused_backward(const TinyMlpShape& s, Workspace& arena, const Tensors<float>& t, const FieldIn<float>& in,
                    View<const float> rgb, const FieldGrad<float>& grad, View<float> d_position) {
  if (in.position.rows == 0) return;
  const Workspace::Scope scope(arena);
  const FusedCall call = fused_call(s, t, in);
  const Gradients gradients{grad,       as_bf16(grad.fused.feature),  rgb,
                            d_position, allows_vectors(grad.feature), allows_vectors(d_position)};
  const auto d = network_of<float>(s, [&](int index) { return t.grad[static_cast<std::size_t>(index)]; });
  with_tiles(s, [&]<int kPositionTiles, int kDirectionTiles>() {
    const auto kernel = backward_kernel<kPositionTiles, kDirectionTiles>;
    constexpr std::size_t kBytes = sizeof(Memory<kPositionTiles, kDirectionTiles>);
    static_assert(kBytes <= kMostSharedMemory);
    constexpr int kSums = Layout<kPositionTiles, kDirectionTiles>::kSize;
    const unsigned blocks = std::min(resident_blocks(reinterpret_cast<const void*>(kernel), kBackwardThreads, kBytes),
                                     blocks_of(in.position.rows, kBlockRows));
    const View<float> partial = arena.take<float>(blocks, kSums);
    kernel<<<blocks, kBackwardThreads, kBytes, launch().stream>>>(call, gradients, partial.data);
    check_launch("small network: fused backward");
    sum_blocks_kernel<kPositionTiles, kDirectionTiles>
        <<<blocks_of(kSums, kSumColumns), dim3(kSumColumns, kSumSegments), 0, launch().stream>>>(
            partial.data, static_cast<int>(blocks), d);
    check_launch("small network: sum of the blocks");
  });
}

}  // namespace semfield::cuda::tiny
