// Forward of the hidden layers, and the way back through them.
#include <algorithm>

#include "core/check.h"
#include "cuda/kernels/kernels.h"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"

namespace semfield::cuda::tiny {

namespace {

constexpr int kThreads = 256;
constexpr int kBlockRows = kThreads / kWarp * kTileRows;

/// The hidden layers' tensors [in, out], [1, out], or their gradients.
template <class T>
struct LayersOf {
  View<T> weight[kTinyFusedFeatureLayers], bias[kTinyFusedFeatureLayers];
  int count = 0;
};

/// Columns of a matrix in whole groups.
constexpr int padded_columns(int columns) { return (columns + kGroup - 1) / kGroup * kGroup; }

/// Rows that the layers read, rounded, in whole groups of columns; the last layer's are the feature itself.
struct Activations {
  View<__nv_bfloat16> position;  ///< [M, .]; empty: nothing is kept
  View<__nv_bfloat16> hidden;    ///< [layers * M, .]
};

struct Call {
  LayersOf<const float> layers;
  Activations kept;
  const std::int32_t* live = nullptr;
  std::int64_t rows = 0;
  /// What layer l made, or dL/d(its sums), of all layers.
  __host__ __device__ View<__nv_bfloat16> layer(View<__nv_bfloat16> of, int l) const {
    return of.row_range(l * rows, rows);
  }
};

/// Where a column, a multiple of 4 as the first of four, stands in its group of 16: the first two here, the others 8
/// later.
__device__ constexpr int position_of(int column) { return (column & ~15) + (column & 15) / 2; }

/// A layer's weights in shared memory, bf16, rows and columns at their positions. A thread takes four columns of a row.
template <int kIn, int kOut>
__device__ inline void load_weight(View<const float> w, __nv_bfloat16* to) {
  constexpr int kAtOnce = 8, kChunks = kOut * kGroup / 4, kCount = kIn * kGroup * kChunks;
  const bool vector = w.cols % 4 == 0 && w.row_stride % 4 == 0 && reinterpret_cast<std::uintptr_t>(w.data) % 16 == 0;
  for (int first = static_cast<int>(threadIdx.x); first < kCount; first += kAtOnce * kThreads) {
    float4 loaded[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = first + k * kThreads, row = i / kChunks;
      loaded[k] = i < kCount && row < w.rows ? load_four(w, row, i % kChunks * 4, vector) : float4{0, 0, 0, 0};
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = first + k * kThreads, row = i / kChunks;
      if (i >= kCount) continue;
      // Four inputs share a lane as four outputs do: 2q, 2q + 1, 2q + 8, 2q + 9.
      const int at = position_of(row & ~3) + (row & 1) + (row & 2) * 4;
      auto* pair = reinterpret_cast<std::uint32_t*>(to + at * pitch_of(kOut * kGroup) + position_of(i % kChunks * 4));
      pair[0] = pack(loaded[k].x, loaded[k].y);
      pair[4] = pack(loaded[k].z, loaded[k].w);
    }
  }
}
template <int kOut>
__device__ inline void load_bias(View<const float> bias, float* to) {
  for (int i = static_cast<int>(threadIdx.x); i < kOut * kGroup; i += kThreads) {
    const int column = column_of(i);
    to[i] = column < bias.cols ? bias(0, column) : 0.0f;
  }
}

/// Shared memory of `layers` layers: weights one behind the other, then biases.
template <int kIn, int kOut>
struct Memory {
  static constexpr int kPitch = pitch_of(kOut * kGroup), kFirst = kIn * kGroup * kPitch,
                       kOther = kOut * kGroup * kPitch;
  static constexpr std::size_t bytes(int layers) {
    return sizeof(__nv_bfloat16) * static_cast<std::size_t>(kFirst + (layers - 1) * kOther) +
           sizeof(float) * static_cast<std::size_t>(layers * kOut * kGroup);
  }
  __nv_bfloat16* weight;
  int layers;
  __device__ __nv_bfloat16* of(int l) const { return l == 0 ? weight : weight + kFirst + (l - 1) * kOther; }
  __device__ float* bias(int l) const { return reinterpret_cast<float*>(of(layers)) + l * kOut * kGroup; }
};

template <int kGroups>
__device__ inline void load_kept(const Lane& lane, View<__nv_bfloat16> from, std::int64_t row0, std::int64_t rows,
                                 Fragment (&a)[kGroups]) {
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const std::int64_t row = row0 + lane.g + 8 * half;
#pragma unroll
    for (int k = 0; k < kGroups; ++k) {
      uint2 both{0, 0};
      if (row < rows && k * kGroup < from.cols)
        both = *reinterpret_cast<const uint2*>(from.row(row) + k * kGroup + 4 * lane.q);
      a[k].reg[half] = both.x;
      a[k].reg[2 + half] = both.y;
    }
  }
}

struct Thread {
  std::int64_t number, count;
  std::int64_t row0, stride;  // of its warp's first rows, and to the next
  __device__ Thread()
      : number(static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x),
        count(static_cast<std::int64_t>(gridDim.x) * kThreads),
        row0(number / kWarp * kTileRows),
        stride(static_cast<std::int64_t>(gridDim.x) * kBlockRows) {}
};

/// A warp takes 16 rows through all layers. A row moves 4 D in, 4 W out and, kept, 2 (D + L W) (D = 112, L = 2, W = 64:
/// 1,184 bytes), and takes 2 (D W + (L - 1) W W) operations. Rows do not depend on each other.
template <int kIn, int kOut>
__global__ void __launch_bounds__(kThreads, 1)
    forward_kernel(const Call call, View<const float> position, View<float> feature, bool vector_in, bool vector_out) {
  extern __shared__ __align__(16) unsigned char shared_memory[];
  using M = Memory<kIn, kOut>;
  const M memory{reinterpret_cast<__nv_bfloat16*>(shared_memory), call.layers.count};
  const Lane lane(static_cast<int>(threadIdx.x) % kWarp);
  const Thread thread;
  const std::int64_t rows = live_count(call.live, call.rows);
  if (static_cast<std::int64_t>(blockIdx.x) * kBlockRows < rows) {
    load_weight<kIn, kOut>(call.layers.weight[0], memory.of(0));
    for (int l = 1; l < memory.layers; ++l) load_weight<kOut, kOut>(call.layers.weight[l], memory.of(l));
    for (int l = 0; l < memory.layers; ++l) load_bias<kOut>(call.layers.bias[l], memory.bias(l));
    __syncthreads();
  }
  for (std::int64_t row0 = thread.row0; row0 < rows; row0 += thread.stride) {
    Sums y[2 * kOut];
    Fragment h[kOut];
    {
      Fragment x[kIn];
      {
        Sums loaded[2 * kIn];
        load_rows<kIn>(lane, position, row0, rows, vector_in, loaded);
        pack_all(loaded, x);
      }
      if (!call.kept.position.empty()) store_rows(lane, x, row0, rows, call.kept.position);
      start(lane, memory.bias(0), y);
      forward_product<M::kPitch>(lane, x, memory.of(0), y);
    }
    for (int l = 0;; ++l) {
      relu(y);
      pack_all(y, h);
      if (!call.kept.position.empty()) store_rows(lane, h, row0, rows, call.layer(call.kept.hidden, l));
      if (l + 1 == memory.layers) break;
      start(lane, memory.bias(l + 1), y);
      forward_product<M::kPitch>(lane, h, memory.of(l + 1), y);
    }
    store_rows<kOut>(lane, y, row0, rows, vector_out, feature);
  }
  clear_rows(feature, rows, thread.number, thread.count);
}

/// The gradient before each layer's ReLU into all_dz, as Activations::hidden, and of the position: 4 W + 2 L W in and 2
/// L W
/// (+ 4 D) out a row.
template <int kIn, int kOut>
__global__ void __launch_bounds__(kThreads, 1)
    backward_kernel(const Call call, View<const float> d_feature, View<__nv_bfloat16> all_dz, View<float> d_position,
                    bool vector_in, bool vector_out) {
  extern __shared__ __align__(16) unsigned char shared_memory[];
  using M = Memory<kIn, kOut>;
  const M memory{reinterpret_cast<__nv_bfloat16*>(shared_memory), call.layers.count};
  const Lane lane(static_cast<int>(threadIdx.x) % kWarp);
  const Thread thread;
  const std::int64_t rows = live_count(call.live, call.rows);
  if (static_cast<std::int64_t>(blockIdx.x) * kBlockRows < rows) {
    if (!d_position.empty()) load_weight<kIn, kOut>(call.layers.weight[0], memory.of(0));
    for (int l = 1; l < memory.layers; ++l) load_weight<kOut, kOut>(call.layers.weight[l], memory.of(l));
    __syncthreads();
  }
  for (std::int64_t row0 = thread.row0; row0 < rows; row0 += thread.stride) {
    Sums dy[2 * kOut];
    Fragment h[kOut], dz[kOut];
    load_rows<kOut>(lane, d_feature, row0, rows, vector_in, dy);
    for (int l = memory.layers - 1;; --l) {
      load_kept(lane, call.layer(call.kept.hidden, l), row0, rows, h);
      mask_and_pack(dy, h, dz);
      store_rows(lane, dz, row0, rows, call.layer(all_dz, l));
      if (l == 0) break;
      clear(dy);
      backward_product<M::kPitch>(lane, dz, memory.of(l), dy);
    }
    if (d_position.empty()) continue;
    Sums dx[2 * kIn];
    clear(dx);
    backward_product<M::kPitch>(lane, dz, memory.of(0), dx);
    store_rows<kIn>(lane, dx, row0, rows, vector_out, d_position);
  }
  if (!d_position.empty()) clear_rows(d_position, rows, thread.number, thread.count);
}

/// Calls run.template operator()<tiles of the position, tiles of a layer>() for the shape's widths.
template <class Run>
void with_widths(const TinyMlpShape& s, const Run& run) {
  const bool wide_in = s.position_dims > kWidth, wide = s.hidden_width > kWidth;
  if (wide_in && wide) return run.template operator()<8, 8>();
  if (wide_in) return run.template operator()<8, 4>();
  if (wide) return run.template operator()<4, 8>();
  run.template operator()<4, 4>();
}

template <class T, class ViewOf>
LayersOf<T> layers_of(const TinyMlpShape& s, const ViewOf& view) {
  LayersOf<T> layers;
  for (const LayerTensors& layer : s.hidden) {
    layers.weight[layers.count] = view(layer.weight);
    layers.bias[layers.count++] = view(layer.bias);
  }
  return layers;
}

Activations activations(const TinyMlpShape& s, std::int64_t rows, std::byte* memory) {
  const int columns = padded_columns(s.position_dims);
  auto* const first = reinterpret_cast<__nv_bfloat16*>(memory);
  if (memory == nullptr) return {};
  return {{first, rows, columns},
          {first + rows * columns, rows * static_cast<std::int64_t>(s.hidden.size()), padded_columns(s.hidden_width)}};
}

Call call_of(const TinyMlpShape& s, const Tensors<float>& t, std::int64_t rows, Saved saved) {
  return {layers_of<const float>(
              s, [&](int index) -> View<const float> { return t.value[static_cast<std::size_t>(index)]; }),
          activations(s, rows, saved.empty() ? nullptr : saved.data()), launch().live_rows, rows};
}

template <int kIn, int kOut>
unsigned blocks_for(const void* kernel, int layers, std::int64_t rows) {
  return std::min(resident_blocks(kernel, kThreads, Memory<kIn, kOut>::bytes(layers)), blocks_of(rows, kBlockRows));
}

// Weight gradients of the hidden layers from what forward kept and the gradients before each ReLU.

constexpr int kWeightThreads = 128;
constexpr int kTile = 64;  // rows, inputs and outputs that a block takes at a time
constexpr int kTilePitch = pitch_of(kTile);
constexpr int kChunk = 8;                                        // numbers of 16 bytes
constexpr int kLoads = kTile * kTile / kChunk / kWeightThreads;  // of a thread
constexpr std::int64_t kFewestRows = 128, kMostRanges = 128;

/// Everything a block has to know: the layers' gradients, their operands, and where partial sums lie.
struct WeightCall {
  LayersOf<float> d;
  Call from;
  View<__nv_bfloat16> dz;
  std::int64_t rows_a_range = 0;
  std::int64_t start[kTinyFusedFeatureLayers + 1] = {};  // of a layer within the partial sums of a range: [in + 1, out]
  float* partial = nullptr;
};

/// One layer as a block of the grid sees it.
struct Place {
  int layer = 0, in0 = 0, out0 = 0;
};
constexpr int tiles_of(int numbers) { return (numbers + kTile - 1) / kTile; }
/// Tiles are numbered layer by layer; the number behind the last is their count.
__host__ __device__ inline Place place_of(const LayersOf<float>& d, int tile) {
  for (int l = 0; l < d.count; ++l) {
    const int across = tiles_of(d.weight[l].cols), all = tiles_of(static_cast<int>(d.weight[l].rows)) * across;
    if (tile < all) return {l, tile / across * kTile, tile % across * kTile};
    tile -= all;
  }
  return {d.count, 0, 0};
}

/// 64 rows of 64 columns of a matrix without gaps on their way to shared memory; what lies outside is 0.
struct Fetched {
  uint4 chunk[kLoads];
  __device__ void load(View<__nv_bfloat16> from, int col0, std::int64_t row0, std::int64_t end) {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int number = static_cast<int>(threadIdx.x) + i * kWeightThreads,
                col = col0 + number % (kTile / kChunk) * kChunk;
      const std::int64_t row = row0 + number / (kTile / kChunk);
      chunk[i] = row < end && col < from.cols ? *reinterpret_cast<const uint4*>(from.data + row * from.cols + col)
                                              : uint4{0, 0, 0, 0};
    }
  }
  __device__ void store(__nv_bfloat16* to) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int number = static_cast<int>(threadIdx.x) + i * kWeightThreads;
      *reinterpret_cast<uint4*>(to + number / (kTile / kChunk) * kTilePitch + number % (kTile / kChunk) * kChunk) =
          chunk[i];
    }
  }
};

/// Block (range, tile): the sums over a range of rows of 64 inputs and 64 outputs of a layer; warp w has inputs
/// 32 (w % 2) .. and outputs 32 (w / 2) .. of them. 256 bytes per row.
__global__ void __launch_bounds__(kWeightThreads, 4) partial_kernel(const WeightCall call) {
  __shared__ __align__(16) __nv_bfloat16 x_tile[kTile * kTilePitch], dz_tile[kTile * kTilePitch];
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * call.rows_a_range;
  const std::int64_t rows = live_count(call.from.live, call.from.rows);
  const std::int64_t end = first + call.rows_a_range < rows ? first + call.rows_a_range : rows;
  if (first >= end) return;
  const Place place = place_of(call.d, static_cast<int>(blockIdx.y));
  const int lane_number = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const Lane lane(lane_number);
  const int in = warp % 2 * 32, out = warp / 2 * 32;
  const Activations& kept = call.from.kept;
  const View<__nv_bfloat16> x = place.layer == 0 ? kept.position : call.from.layer(kept.hidden, place.layer - 1);
  const View<__nv_bfloat16> dz = call.from.layer(call.dz, place.layer);

  Sums sums[2][4];
  clear(sums[0]);
  clear(sums[1]);
  float bias[2] = {};
  Fetched next_x, next_dz;
  next_x.load(x, place.in0, first, end);
  next_dz.load(dz, place.out0, first, end);
  for (std::int64_t row0 = first; row0 < end; row0 += kTile) {
    __syncthreads();
    next_x.store(x_tile);
    next_dz.store(dz_tile);
    __syncthreads();
    if (row0 + kTile < end) {  // on their way while this tile is summed
      next_x.load(x, place.in0, row0 + kTile, end);
      next_dz.load(dz, place.out0, row0 + kTile, end);
    }
#pragma unroll
    for (int row = 0; row < kTile; row += kGroup)
      add_square<kTilePitch>(lane, warp, x_tile, in, dz_tile, out, row, sums, bias);
  }

  const View<float> weight = call.d.weight[place.layer];
  const auto ins = static_cast<int>(weight.rows), outs = weight.cols;
  float* const to =
      call.partial + static_cast<std::int64_t>(blockIdx.x) * call.start[call.d.count] + call.start[place.layer];
#pragma unroll
  for (int m = 0; m < 2; ++m) {
#pragma unroll
    for (int n = 0; n < 4; ++n) {
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const int row = place.in0 + in + m * kGroup + lane.g + 8 * (i / 2);
        const int col = place.out0 + out + n * 8 + 2 * lane.q + i % 2;
        if (row < ins && col < outs) to[row * outs + col] = sums[m][n].value[i];
      }
    }
  }
#pragma unroll
  for (int n = 0; n < 2; ++n) {  // lanes with the same g hold rows of the same column
    float sum = bias[n];
    sum += __shfl_xor_sync(kFullMask, sum, 1);
    sum += __shfl_xor_sync(kFullMask, sum, 2);
    const int col = place.out0 + out + warp % 2 * kGroup + n * 8 + lane.g;
    if (place.in0 == 0 && lane.q == 0 && col < outs) to[ins * outs + col] = sum;
  }
}

/// Gradients += sums of the ranges in use, in their order.
__global__ void __launch_bounds__(kSumColumns* kSumSegments) sum_kernel(const WeightCall call) {
  const std::int64_t element = static_cast<std::int64_t>(blockIdx.x) * kSumColumns + threadIdx.x;
  const std::int64_t rows = live_count(call.from.live, call.from.rows);
  const auto ranges = static_cast<int>((rows + call.rows_a_range - 1) / call.rows_a_range);
  const float sum = sum_of_partials(call.partial, ranges, call.start[call.d.count], element);
  if (threadIdx.y != 0 || element >= call.start[call.d.count]) return;
  int l = 0;
  while (element >= call.start[l + 1]) ++l;
  const View<float> weight = call.d.weight[l];
  const std::int64_t in = (element - call.start[l]) / weight.cols;
  const auto out = static_cast<std::int32_t>((element - call.start[l]) % weight.cols);
  if (in < weight.rows) {
    call.d.weight[l](in, out) += sum;
  } else {
    call.d.bias[l](0, out) += sum;
  }
}

/// d_weight += x^T dz and d_bias += column sums of dz for every layer, over the rows before *live. Sums over fixed
/// ranges of rows are added in order: same bits in every run.
void weight_gradients(const LayersOf<float>& d, const Call& from, View<__nv_bfloat16> dz, Workspace& arena) {
  WeightCall call{d, from, dz};
  call.rows_a_range = std::max(kFewestRows, (from.rows + kMostRanges - 1) / kMostRanges);
  int tiles = 0;
  for (int l = 0; l < d.count; ++l) {
    const View<float>& weight = d.weight[l];
    call.start[l + 1] = call.start[l] + (weight.rows + 1) * weight.cols;
    tiles += tiles_of(static_cast<int>(weight.rows)) * tiles_of(weight.cols);
  }
  const std::int64_t ranges = (from.rows + call.rows_a_range - 1) / call.rows_a_range;
  call.partial = arena.take<float>(ranges, static_cast<std::int32_t>(call.start[d.count])).data;
  partial_kernel<<<dim3(static_cast<unsigned>(ranges), static_cast<unsigned>(tiles)), kWeightThreads, 0,
                   launch().stream>>>(call);
  check_launch("small network: weight gradients of a feature");
  sum_kernel<<<blocks_of(call.start[d.count], kSumColumns), dim3(kSumColumns, kSumSegments), 0, launch().stream>>>(
      call);
  check_launch("small network: sum of the ranges");
}

}  // namespace

bool feature_applies(const TinyMlpShape& s) {
  return fused_takes_feature(s) && shared_memory_limit() >= Memory<8, 8>::bytes(static_cast<int>(s.hidden.size()));
}

std::size_t feature_saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  const auto columns = static_cast<std::int64_t>(padded_columns(s.position_dims)) +
                       static_cast<std::int64_t>(s.hidden.size()) * padded_columns(s.hidden_width);
  return sizeof(__nv_bfloat16) * static_cast<std::size_t>(samples * columns);
}

void feature_forward(const TinyMlpShape& s, const Tensors<float>& t, View<const float> position, View<float> feature,
                     Saved saved) {
  if (position.rows == 0) return;
  const Call call = call_of(s, t, position.rows, saved);
  with_widths(s, [&]<int kIn, int kOut>() {
    const auto kernel = forward_kernel<kIn, kOut>;
    const unsigned blocks =
        blocks_for<kIn, kOut>(reinterpret_cast<const void*>(kernel), call.layers.count, position.rows);
    kernel<<<blocks, kThreads, Memory<kIn, kOut>::bytes(call.layers.count), launch().stream>>>(
        call, position, feature, allows_vectors(position), allows_vectors(feature));
    check_launch("small network: forward of a feature");
  });
}

void feature_backward(const TinyMlpShape& s, Workspace& arena, const Tensors<float>& t, View<const float> d_feature,
                      Saved saved, View<float> d_position) {
  if (d_feature.rows == 0) {
    if (!d_position.empty()) cuda::fill(d_position, 0.0F);
    return;
  }
  SEMFIELD_CHECK(!saved.empty(), "a gradient of the feature needs what forward saved");
  const Workspace::Scope scope(arena);
  const Call call = call_of(s, t, d_feature.rows, saved);
  const auto dz = arena.take<__nv_bfloat16>(call.kept.hidden.rows, call.kept.hidden.cols);
  with_widths(s, [&]<int kIn, int kOut>() {
    const auto kernel = backward_kernel<kIn, kOut>;
    const unsigned blocks =
        blocks_for<kIn, kOut>(reinterpret_cast<const void*>(kernel), call.layers.count, d_feature.rows);
    kernel<<<blocks, kThreads, Memory<kIn, kOut>::bytes(call.layers.count), launch().stream>>>(
        call, d_feature, dz, d_position, allows_vectors(d_feature), allows_vectors(d_position));
    check_launch("small network: backward of a feature");
  });
  const auto d = layers_of<float>(s, [&](int index) { return t.grad[static_cast<std::size_t>(index)]; });
  weight_gradients(d, call, dz, arena);
}

}  // namespace semfield::cuda::tiny
