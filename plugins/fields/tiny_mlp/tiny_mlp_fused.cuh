// What the fused kernels of the small network share: weights of the whole network in shared memory, and its layers for
// the 16 rows of one warp, whose activations stay in registers.
//
// Products are mma.sync.m16n8k16 [PTX ISA 9.7.14] with bf16 operands and fp32 sums. The registers in which a warp holds
// two neighbouring 8-column results are, rounded and packed, those in which the next product wants its 16 inputs, so a
// chain of layers moves nothing. Lane 4 g + q holds rows g and g + 8, and in a group of 16 columns those at positions
// 2q, 2q + 1, 2q + 8, 2q + 9. Columns are numbered so that these are columns 4q .. 4q + 3 (column_of): 16 bytes in
// memory. Widths are padded with zeros: position to 16 kPositionTiles, hidden and colour to 64, geometry and direction
// to 16, colour's three outputs to 8.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>

#include "cuda/kernels/device_code.cuh"
#include "fields/tiny_mlp/tiny_mlp.h"

namespace semfield::cuda::tiny {

inline constexpr int kWidth = 64;     // of hidden and colour layers, padded
inline constexpr int kGroup = 16;     // columns that a product takes at a time
inline constexpr int kTileRows = 16;  // rows of a warp
inline constexpr int kRgbPitch = 8;
/// Elements between rows of a matrix in shared memory: 8 rows of 16 bytes lie in different banks.
constexpr int pitch_of(int cols) { return cols + 8; }

/// Parameters of the network, or their gradients, in device memory, fp32: weights [in, out], biases [1, out].
template <class T>
struct NetworkOf {
  View<T> hidden, geometry, color_0, color_1, rgb;
  View<T> hidden_bias, geometry_bias, color_0_bias, color_1_bias, rgb_bias;
};
using Network = NetworkOf<const float>;
using NetworkGradient = NetworkOf<float>;
/// From a shape's tensor numbers; `view` gives the view of one.
template <class T, class ViewOf>
NetworkOf<T> network_of(const TinyMlpShape& s, const ViewOf& view) {
  return {view(s.hidden[0].weight), view(s.geometry.weight), view(s.color[0].weight), view(s.color[1].weight),
          view(s.rgb.weight),       view(s.hidden[0].bias),  view(s.geometry.bias),   view(s.color[0].bias),
          view(s.color[1].bias),    view(s.rgb.bias)};
}

/// One 16 x 16 operand of a lane, or half of a 16 x 16 result rounded: rows g, g + 8, g, g + 8 and positions 2q, 2q,
/// 2q + 8, 2q + 8.
struct Fragment {
  std::uint32_t reg[4];
};
/// Sums of 8 columns: rows g, g, g + 8, g + 8 and positions 2q, 2q + 1, 2q, 2q + 1.
struct Sums {
  float value[4];
};

/// The column at a position of a group of 16; larger positions keep their group.
__host__ __device__ constexpr int column_of(int position) {
  return (position & ~15) + 4 * ((position & 7) >> 1) + 2 * ((position & 15) >> 3) + (position & 1);
}

__device__ inline std::uint32_t pack(float low, float high) {
  const __nv_bfloat162 pair = __floats2bfloat162_rn(low, high);
  return *reinterpret_cast<const std::uint32_t*>(&pair);
}
__device__ inline Fragment pack(const Sums& low, const Sums& high) {
  return {{pack(low.value[0], low.value[1]), pack(low.value[2], low.value[3]), pack(high.value[0], high.value[1]),
           pack(high.value[2], high.value[3])}};
}

__device__ inline void multiply_add(Sums& c, const Fragment& a, std::uint32_t b0, std::uint32_t b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};\n"
      : "+f"(c.value[0]), "+f"(c.value[1]), "+f"(c.value[2]), "+f"(c.value[3])
      : "r"(a.reg[0]), "r"(a.reg[1]), "r"(a.reg[2]), "r"(a.reg[3]), "r"(b0), "r"(b1));
}
/// The same over 8 inputs.
__device__ inline void multiply_add(Sums& c, std::uint32_t a0, std::uint32_t a1, std::uint32_t b) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5}, {%6}, {%0,%1,%2,%3};\n"
      : "+f"(c.value[0]), "+f"(c.value[1]), "+f"(c.value[2]), "+f"(c.value[3])
      : "r"(a0), "r"(a1), "r"(b));
}

/// Four 8 x 8 matrices; lane l gives the address of row l % 8 of matrix l / 8.
__device__ inline Fragment load_matrices(const __nv_bfloat16* row) {
  Fragment f;
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];\n"
               : "=r"(f.reg[0]), "=r"(f.reg[1]), "=r"(f.reg[2]), "=r"(f.reg[3])
               : "r"(static_cast<std::uint32_t>(__cvta_generic_to_shared(row))));
  return f;
}
__device__ inline Fragment load_transposed(const __nv_bfloat16* row) {
  Fragment f;
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];\n"
               : "=r"(f.reg[0]), "=r"(f.reg[1]), "=r"(f.reg[2]), "=r"(f.reg[3])
               : "r"(static_cast<std::uint32_t>(__cvta_generic_to_shared(row))));
  return f;
}

/// What a lane has to know of itself.
struct Lane {
  int g, q;           // rows g and g + 8, columns 4q .. 4q + 3 of a group
  int row_8, row_16;  // row within matrices 0 and 1, or 0 to 3, that it addresses
  int low_8, high_8;  // 8 for the lanes of odd matrices, and of matrices 2 and 3
  __device__ explicit Lane(int lane)
      : g(lane / 4), q(lane % 4), row_8(lane % 8), row_16(lane), low_8(lane & 8), high_8((lane & 16) / 2) {}
};

/// y += a W for 8 kSums columns; w [16 kGroups, .] in shared memory.
template <int kPitch, int kGroups, int kSums>
__device__ inline void forward_product(const Lane& lane, const Fragment (&a)[kGroups], const __nv_bfloat16* w,
                                       Sums (&y)[kSums]) {
  const __nv_bfloat16* at = w + (lane.row_8 + lane.low_8) * kPitch + lane.high_8;
#pragma unroll
  for (int k = 0; k < kGroups; ++k) {
#pragma unroll
    for (int n = 0; n < kSums; n += 2) {
      const Fragment b = load_transposed(at + k * kGroup * kPitch + n * 8);
      multiply_add(y[n], a[k], b.reg[0], b.reg[1]);
      multiply_add(y[n + 1], a[k], b.reg[2], b.reg[3]);
    }
  }
}

/// dx += dz W^T for 8 kSums inputs; w [8 kSums, .] in shared memory.
template <int kPitch, int kGroups, int kSums>
__device__ inline void backward_product(const Lane& lane, const Fragment (&dz)[kGroups], const __nv_bfloat16* w,
                                        Sums (&dx)[kSums]) {
  const __nv_bfloat16* at = w + (lane.row_8 + lane.high_8) * kPitch + lane.low_8;
#pragma unroll
  for (int k = 0; k < kGroups; ++k) {
#pragma unroll
    for (int n = 0; n < kSums; n += 2) {
      const Fragment b = load_matrices(at + n * 8 * kPitch + k * kGroup);
      multiply_add(dx[n], dz[k], b.reg[0], b.reg[1]);
      multiply_add(dx[n + 1], dz[k], b.reg[2], b.reg[3]);
    }
  }
}

template <int kSums>
__device__ inline void start(const Lane& lane, const float* bias, Sums (&y)[kSums]) {
#pragma unroll
  for (int n = 0; n < kSums; ++n) {
    const float2 b = *reinterpret_cast<const float2*>(bias + n * 8 + 2 * lane.q);
    y[n] = Sums{{b.x, b.y, b.x, b.y}};
  }
}
template <int kSums>
__device__ inline void relu(Sums (&y)[kSums]) {
#pragma unroll
  for (Sums& sums : y) {
#pragma unroll
    for (float& value : sums.value) value = value <= 0.0f ? 0.0f : value;  // NaN stays NaN
  }
}
template <int kSums>
__device__ inline void pack_all(const Sums (&y)[kSums], Fragment (&a)[kSums / 2]) {
#pragma unroll
  for (int k = 0; k < kSums / 2; ++k) a[k] = pack(y[2 * k], y[2 * k + 1]);
}

/// dz = y > 0 ? dy : 0, rounded.
template <int kGroups>
__device__ inline void mask_and_pack(const Sums (&dy)[2 * kGroups], const Fragment (&y)[kGroups],
                                     Fragment (&dz)[kGroups]) {
  const __nv_bfloat162 zero = __float2bfloat162_rn(0.0f);
  pack_all(dy, dz);
#pragma unroll
  for (int k = 0; k < kGroups; ++k) {
#pragma unroll
    for (int i = 0; i < 4; ++i)
      dz[k].reg[i] &= __hgt2_mask(*reinterpret_cast<const __nv_bfloat162*>(&y[k].reg[i]), zero);
  }
}
template <int kCount>
__device__ inline void clear(Sums (&sums)[kCount]) {
#pragma unroll
  for (Sums& s : sums) s = Sums{};
}

/// Operands of a weight gradient x^T dz from rows in shared memory: 16 inputs of 16 rows as the left one,
template <int kRowPitch>
__device__ inline Fragment inputs(const Lane& lane, const __nv_bfloat16* x, int row, int col) {
  return load_transposed(x + (row + lane.row_8 + lane.high_8) * kRowPitch + col + lane.low_8);
}
/// 16 outputs of 16 rows as two right ones.
template <int kRowPitch>
__device__ inline Fragment outputs(const Lane& lane, const __nv_bfloat16* dz, int row, int col) {
  return load_transposed(dz + (row + lane.row_8 + lane.low_8) * kRowPitch + col + lane.high_8);
}
/// Of the four numbers of an output that a lane holds in two registers of outputs(): a bias gradient's terms.
__device__ inline float column_sum(std::uint32_t a, std::uint32_t b) {
  const float2 x = __bfloat1622float2(*reinterpret_cast<const __nv_bfloat162*>(&a));
  const float2 y = __bfloat1622float2(*reinterpret_cast<const __nv_bfloat162*>(&b));
  return (x.x + x.y) + (y.x + y.y);
}

/// Onto a warp's sums of a weight gradient: 32 inputs from column `in` of x and 32 outputs from column `out` of dz,
/// over 16 rows from `row` on, and onto its bias sums 16 of the outputs. Warps 0 and 1 hold the same outputs, and so do
/// 2 and 3: each sums 16 of them.
template <int kRowPitch>
__device__ inline void add_square(const Lane& lane, int warp, const __nv_bfloat16* x, int in, const __nv_bfloat16* dz,
                                  int out, int row, Sums (&sums)[2][4], float (&bias)[2]) {
  const Fragment d[2] = {outputs<kRowPitch>(lane, dz, row, out), outputs<kRowPitch>(lane, dz, row, out + kGroup)};
#pragma unroll
  for (int m = 0; m < 2; ++m) {
    const Fragment from = inputs<kRowPitch>(lane, x, row, in + m * kGroup);
#pragma unroll
    for (int n = 0; n < 2; ++n) {
      multiply_add(sums[m][2 * n], from, d[n].reg[0], d[n].reg[1]);
      multiply_add(sums[m][2 * n + 1], from, d[n].reg[2], d[n].reg[3]);
    }
  }
  const Fragment mine = warp % 2 == 0 ? d[0] : d[1];
  bias[0] += column_sum(mine.reg[0], mine.reg[1]);
  bias[1] += column_sum(mine.reg[2], mine.reg[3]);
}

/// Numbers 4q .. 4q + 3 of group `group` of a row; 0 outside the columns. `vector`: 16-byte accesses are possible.
__device__ inline float4 load_four(View<const float> view, std::int64_t row, int col, bool vector) {
  const float* at = view.row(row) + col;
  if (vector) return col < view.cols ? *reinterpret_cast<const float4*>(at) : float4{0, 0, 0, 0};
  return {col < view.cols ? at[0] : 0.0f, col + 1 < view.cols ? at[1] : 0.0f, col + 2 < view.cols ? at[2] : 0.0f,
          col + 3 < view.cols ? at[3] : 0.0f};
}
__device__ inline void store_four(View<float> view, std::int64_t row, int col, bool vector, float4 v) {
  float* at = view.row(row) + col;
  if (vector) {
    if (col < view.cols) *reinterpret_cast<float4*>(at) = v;
    return;
  }
  if (col < view.cols) at[0] = v.x;
  if (col + 1 < view.cols) at[1] = v.y;
  if (col + 2 < view.cols) at[2] = v.z;
  if (col + 3 < view.cols) at[3] = v.w;
}
/// Whether rows of a view allow the vector accesses of load_four.
template <class T>
bool allows_vectors(const View<T>& view) {
  return view.cols % 4 == 0 && view.row_stride % 4 == 0 && reinterpret_cast<std::uintptr_t>(view.data) % 16 == 0;
}
__device__ inline Fragment pack(const float4& row, const float4& row_8) {
  return {{pack(row.x, row.y), pack(row_8.x, row_8.y), pack(row.z, row.w), pack(row_8.z, row_8.w)}};
}

/// A lane's four columns of each group of rows g and g + 8 from `row0` on, in memory as columns, where they lie before
/// row `rows` and the view's last group: rounded,
template <int kGroups>
__device__ inline void store_rows(const Lane& lane, const Fragment (&a)[kGroups], std::int64_t row0, std::int64_t rows,
                                  View<__nv_bfloat16> to) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
    if (row >= rows) continue;
#pragma unroll
    for (int k = 0; k < kGroups; ++k) {
      if (k * kGroup >= to.cols) break;
      *reinterpret_cast<uint2*>(to.row(row) + k * kGroup + 4 * lane.q) = {a[k].reg[half], a[k].reg[2 + half]};
    }
  }
}
/// and in fp32; what is read elsewhere is 0. `vector` as in load_four.
template <int kGroups>
__device__ inline void store_rows(const Lane& lane, const Sums (&from)[2 * kGroups], std::int64_t row0,
                                  std::int64_t rows, bool vector, View<float> to) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
    if (row >= rows) continue;
#pragma unroll
    for (int k = 0; k < kGroups; ++k) {
      const Sums &low = from[2 * k], &high = from[2 * k + 1];
      store_four(to, row, k * kGroup + 4 * lane.q, vector,
                 {low.value[2 * half], low.value[2 * half + 1], high.value[2 * half], high.value[2 * half + 1]});
    }
  }
}
template <int kGroups>
__device__ inline void load_rows(const Lane& lane, View<const float> from, std::int64_t row0, std::int64_t rows,
                                 bool vector, Sums (&to)[2 * kGroups]) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
#pragma unroll
    for (int k = 0; k < kGroups; ++k) {
      const float4 v = row < rows ? load_four(from, row, k * kGroup + 4 * lane.q, vector) : float4{0, 0, 0, 0};
      to[2 * k].value[2 * half] = v.x;
      to[2 * k].value[2 * half + 1] = v.y;
      to[2 * k + 1].value[2 * half] = v.z;
      to[2 * k + 1].value[2 * half + 1] = v.w;
    }
  }
}

/// The network in shared memory: weights in bf16, rows and columns at their positions; biases in fp32. The first colour
/// layer reads [1, geometry features, direction]: the slot of sigma holds a one, whose weights are 0 and whose weight
/// gradient is the bias gradient.
template <int kPositionTiles, int kDirectionTiles>
struct alignas(16) Weights {
  static constexpr int kPosition = kPositionTiles * kGroup, kColorIn = (1 + kDirectionTiles) * kGroup;
  static constexpr int kPitch = pitch_of(kWidth), kNarrow = pitch_of(kGroup);
  __nv_bfloat16 hidden[kPosition * kPitch];
  __nv_bfloat16 geometry[kWidth * kNarrow];
  __nv_bfloat16 color_0[kColorIn * kPitch];
  __nv_bfloat16 color_1[kWidth * kPitch];
  __nv_bfloat16 rgb[kWidth * kRgbPitch];
  float hidden_bias[kWidth], geometry_bias[kGroup], color_0_bias[kWidth], color_1_bias[kWidth], rgb_bias[kRgbPitch];

  /// By the whole block; a barrier must follow.
  __device__ void load(const Network& n) {
    constexpr int kAtOnce = 8;  // loads on their way together
    const auto matrix = [](__nv_bfloat16* to, int rows, int cols, int pitch, auto value) {
      const int threads = static_cast<int>(blockDim.x), count = rows * cols;
      for (int first = static_cast<int>(threadIdx.x); first < count; first += kAtOnce * threads) {
        float loaded[kAtOnce];
#pragma unroll
        for (int k = 0; k < kAtOnce; ++k) {
          const int i = first + k * threads;
          loaded[k] = i < count ? value(i / cols, i % cols) : 0.0f;
        }
#pragma unroll
        for (int k = 0; k < kAtOnce; ++k) {
          const int i = first + k * threads;
          if (i < count) to[i / cols * pitch + i % cols] = __float2bfloat16_rn(loaded[k]);
        }
      }
    };
    const auto element = [](View<const float> w, std::int64_t in, int out) {
      return in >= 0 && in < w.rows && out < w.cols ? w(in, out) : 0.0f;
    };
    matrix(hidden, kPosition, kWidth, kPitch,
           [&](int in, int out) { return element(n.hidden, column_of(in), column_of(out)); });
    matrix(geometry, kWidth, kGroup, kNarrow,
           [&](int in, int out) { return element(n.geometry, column_of(in), column_of(out)); });
    const int features = n.geometry.cols - 1;
    matrix(color_0, kColorIn, kWidth, kPitch,
           [&](int in, int out) { return element(n.color_0, color_0_row(in, features), column_of(out)); });
    matrix(color_1, kWidth, kWidth, kPitch,
           [&](int in, int out) { return element(n.color_1, column_of(in), column_of(out)); });
    matrix(rgb, kWidth, kRgbPitch, kRgbPitch, [&](int in, int out) { return element(n.rgb, column_of(in), out); });
    const auto bias = [&](float* to, int cols, View<const float> from, bool numbered) {
      for (int i = static_cast<int>(threadIdx.x); i < cols; i += static_cast<int>(blockDim.x))
        to[i] = element(from, 0, numbered ? column_of(i) : i);
    };
    bias(hidden_bias, kWidth, n.hidden_bias, true);
    bias(geometry_bias, kGroup, n.geometry_bias, true);
    bias(color_0_bias, kWidth, n.color_0_bias, true);
    bias(color_1_bias, kWidth, n.color_1_bias, true);
    bias(rgb_bias, kRgbPitch, n.rgb_bias, false);
  }

  /// Row of the first colour layer's weight whose input stands at `position`; -1: none.
  __host__ __device__ static int color_0_row(int position, int features) {
    const int col = column_of(position);
    if (col < kGroup) return col >= 1 && col <= features ? col - 1 : -1;
    return features + col - kGroup;
  }

  __device__ void hidden_layer(const Lane& lane, const Fragment (&x)[kPositionTiles], Sums (&h)[8]) const {
    start(lane, hidden_bias, h);
    forward_product<kPitch>(lane, x, hidden, h);
    relu(h);
  }
  __device__ void geometry_layer(const Lane& lane, const Fragment (&h)[4], Sums (&out)[2]) const {
    start(lane, geometry_bias, out);
    forward_product<kNarrow>(lane, h, geometry, out);
  }
  __device__ void color_0_layer(const Lane& lane, const Fragment (&in)[1 + kDirectionTiles], Sums (&c)[8]) const {
    start(lane, color_0_bias, c);
    forward_product<kPitch>(lane, in, color_0, c);
    relu(c);
  }
  __device__ void color_1_layer(const Lane& lane, const Fragment (&in)[4], Sums (&c)[8]) const {
    start(lane, color_1_bias, c);
    forward_product<kPitch>(lane, in, color_1, c);
    relu(c);
  }
  __device__ Sums rgb_layer(const Lane& lane, const Fragment (&in)[4]) const {
    Sums y[1];
    start(lane, rgb_bias, y);
#pragma unroll
    for (int k = 0; k < 4; k += 2) {
      const Fragment b = load_transposed(rgb + (k * kGroup + lane.row_16) * kRgbPitch);
      multiply_add(y[0], in[k], b.reg[0], b.reg[1]);
      multiply_add(y[0], in[k + 1], b.reg[2], b.reg[3]);
    }
    return y[0];
  }
};

/// What a lane reads for its rows g and g + 8 of a tile; unused rows are 0.
template <int kPositionTiles, int kDirectionTiles>
struct Inputs {
  float4 position[kPositionTiles][2];
  std::int32_t ray[2];

  __device__ void load(const FieldIn<float>& in, const Lane& lane, std::int64_t row0, std::int64_t rows, bool vector) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const std::int64_t row = row0 + lane.g + 8 * half;
      const bool used = row < rows;
#pragma unroll
      for (int k = 0; k < kPositionTiles; ++k) {
        position[k][half] = used ? load_four(in.position, row, k * kGroup + 4 * lane.q, vector) : float4{0, 0, 0, 0};
      }
      if constexpr (kDirectionTiles > 0) ray[half] = used && !in.direction.empty() ? in.ray_of_sample(row, 0) : -1;
    }
  }
  __device__ void pack_position(Fragment (&x)[kPositionTiles]) const {
#pragma unroll
    for (int k = 0; k < kPositionTiles; ++k) x[k] = pack(position[k][0], position[k][1]);
  }
  /// [1, geometry features, direction], the input of the first colour layer.
  __device__ void color_input(const FieldIn<float>& in, const Lane& lane, bool vector, Sums (&geometry)[2],
                              Fragment (&to)[1 + kDirectionTiles]) const {
    if (lane.q == 0) geometry[0].value[0] = geometry[0].value[2] = 1.0f;
    to[0] = pack(geometry[0], geometry[1]);
    if constexpr (kDirectionTiles > 0) {
      float4 d[2];
#pragma unroll
      for (int half = 0; half < 2; ++half)
        d[half] = ray[half] >= 0 ? load_four(in.direction, ray[half], 4 * lane.q, vector) : float4{0, 0, 0, 0};
      to[1] = pack(d[0], d[1]);
    }
  }
};

// Sums that blocks left in device memory, added in a fixed order.

inline constexpr int kSumColumns = 32, kSumSegments = 8;

/// Sum of partial[r size + element] over r < ranges, in the first warp of a block of (32, 8) threads; element is
/// 32 blockIdx.x + threadIdx.x. A warp reads 32 neighbouring elements, eight warps share the ranges: 4 ranges bytes an
/// element. To be called by all threads.
__device__ inline float sum_of_partials(const float* __restrict__ partial, int ranges, std::int64_t size,
                                        std::int64_t element) {
  __shared__ float segment_sum[kSumSegments][kSumColumns];
  const int each = (ranges + kSumSegments - 1) / kSumSegments;
  const int begin = static_cast<int>(threadIdx.y) * each;
  const int end = begin + each < ranges ? begin + each : ranges;
  float sum = 0;
  if (element < size) {
#pragma unroll 8
    for (int r = begin; r < end; ++r) sum += partial[r * size + element];
  }
  segment_sum[threadIdx.y][threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.y == 0) {
    for (int s = 1; s < kSumSegments; ++s) sum += segment_sum[s][threadIdx.x];
  }
  return sum;
}

// Weight gradients of the fused small network: the operands that a block's rows leave in shared memory, the sums that
// each warp owns over all of the block's tiles, where a block writes them, and their sum over blocks.

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
      add_square<kPitch>(lane, warp, o.color_0, in_1, o.d_color_1, out_1, row, color_1, color_1_bias);
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

// The small network of the usual widths in one kernel a direction: hidden and colour up to 64 wide, one hidden layer,
// two colour layers, bf16 operands. Nothing is saved: backward computes the activations again from the 4 D bytes of an
// encoded position, where saving them would cost 2 (64 + 16 + 64 + 64) bytes per sample twice.

/// Shared memory of the largest kernel; a device that gives a block less takes the layers one by one.
inline constexpr std::size_t kMostSharedMemory = 112 * 1024;
/// Whether the fused kernels compute this network on the current device.
bool fused_applies(const TinyMlpShape& shape);
/// Whether they hand the feature on in bf16 too.
bool shares_feature(const TinyMlpShape& shape);

/// Arguments of either kernel.
struct FusedCall {
  Network network;
  FieldIn<float> in;
  bool hidden_feature = true;  ///< the feature is the hidden layer, else the geometry features
  const std::int32_t* live = nullptr;
  bool vector_position = false, vector_direction = false, vector_feature = false;
};
FusedCall fused_call(const TinyMlpShape& shape, const Tensors<float>& tensors, const FieldIn<float>& in);

void fused_forward(const TinyMlpShape& shape, const Tensors<float>& tensors, const FieldIn<float>& in,
                   const FieldOut<float>& out);
void fused_backward(const TinyMlpShape& shape, Workspace& arena, const Tensors<float>& tensors,
                    const FieldIn<float>& in, View<const float> rgb, const FieldGrad<float>& grad,
                    View<float> d_position);

/// Calls run.template operator()<position tiles, direction tiles>() for the shape's widths.
template <class Run>
void with_tiles(const TinyMlpShape& shape, const Run& run) {
  const auto with_direction = [&]<int kPositionTiles>() {
    if (shape.has_direction()) {
      run.template operator()<kPositionTiles, 1>();
    } else {
      run.template operator()<kPositionTiles, 0>();
    }
  };
  if (shape.position_dims <= kGroup) {
    with_direction.template operator()<1>();
  } else if (shape.position_dims <= 2 * kGroup) {
    with_direction.template operator()<2>();
  } else {
    with_direction.template operator()<4>();
  }
}

/// Most shared memory that a block of the current device may have.
std::size_t shared_memory_limit();
/// Lets a kernel use `bytes` of shared memory, and gives the blocks of it that the device holds at a time.
unsigned resident_blocks(const void* kernel, int threads, std::size_t bytes);

// A network that is asked for its hidden feature alone, such as a semantic branch: hidden layers up to 128 wide and
// positions up to 128 numbers in bf16, all layers in one kernel a direction. Forward keeps what each layer read, 2
// bytes per number; weight gradients of all layers are another kernel over these, since a wide network's sums would not
// stay in a block's registers.

/// Whether these kernels compute this network on the current device.
bool feature_applies(const TinyMlpShape& shape);
std::size_t feature_saved_bytes(const TinyMlpShape& shape, std::int64_t samples);
void feature_forward(const TinyMlpShape& shape, const Tensors<float>& tensors, View<const float> position,
                     View<float> feature, Saved saved);
/// What forward saved of the same rows -> gradients of the tensors and, where it is not empty, of the position.
void feature_backward(const TinyMlpShape& shape, Workspace& arena, const Tensors<float>& tensors,
                      View<const float> d_feature, Saved saved, View<float> d_position);

}  // namespace semfield::cuda::tiny
