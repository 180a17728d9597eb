// Weight gradients of the hidden layers from what forward kept and the gradients before each ReLU.
#include <algorithm>

#include "fields/tiny_mlp/tiny_mlp_feature.cuh"
#include "fields/tiny_mlp/tiny_mlp_partials.cuh"

namespace semfield::cuda::tiny {

namespace {

constexpr int kThreads = 128;
constexpr int kTile = 64;  // rows, inputs and outputs that a block takes at a time
constexpr int kTilePitch = pitch_of(kTile);
constexpr int kChunk = 8;                                  // numbers of 16 bytes
constexpr int kLoads = kTile * kTile / kChunk / kThreads;  // of a thread
constexpr std::int64_t kFewestRows = 128, kMostRanges = 128;

/// Everything a block has to know: the layers' gradients, their operands, and where partial sums lie.
struct Call {
  LayersOf<float> d;
  Activations x;
  const __nv_bfloat16* dz = nullptr;
  const std::int32_t* live = nullptr;
  std::int64_t rows_a_range = 0;
  std::int64_t start[kMostFeatureLayers + 1] = {};  // of a layer within the partial sums of a range: [in + 1, out]
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

/// 64 rows of 64 columns on their way to shared memory; what lies outside is 0.
struct Fetched {
  uint4 chunk[kLoads];
  __device__ void load(const __nv_bfloat16* from, int columns, int col0, std::int64_t row0, std::int64_t end) {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int number = static_cast<int>(threadIdx.x) + i * kThreads, col = col0 + number % (kTile / kChunk) * kChunk;
      const std::int64_t row = row0 + number / (kTile / kChunk);
      chunk[i] =
          row < end && col < columns ? *reinterpret_cast<const uint4*>(from + row * columns + col) : uint4{0, 0, 0, 0};
    }
  }
  __device__ void store(__nv_bfloat16* to) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const int number = static_cast<int>(threadIdx.x) + i * kThreads;
      *reinterpret_cast<uint4*>(to + number / (kTile / kChunk) * kTilePitch + number % (kTile / kChunk) * kChunk) =
          chunk[i];
    }
  }
};

/// Block (range, tile): the sums over a range of rows of 64 inputs and 64 outputs of a layer; warp w has inputs
/// 32 (w % 2) .. and outputs 32 (w / 2) .. of them. 256 bytes per row.
__global__ void __launch_bounds__(kThreads) partial_kernel(const Call call) {
  __shared__ __align__(16) __nv_bfloat16 x_tile[kTile * kTilePitch], dz_tile[kTile * kTilePitch];
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * call.rows_a_range;
  const std::int64_t rows = live_count(call.live, call.x.rows);
  const std::int64_t end = first + call.rows_a_range < rows ? first + call.rows_a_range : rows;
  if (first >= end) return;
  const Place place = place_of(call.d, static_cast<int>(blockIdx.y));
  const int lane_number = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
  const Lane lane(lane_number);
  const int in = warp % 2 * 32, out = warp / 2 * 32;
  const int in_columns = place.layer == 0 ? call.x.position_columns : call.x.width;
  const __nv_bfloat16* const x = place.layer == 0 ? call.x.position : call.x.layer(place.layer - 1);
  const __nv_bfloat16* const dz = call.dz + place.layer * call.x.rows * call.x.width;

  Sums sums[2][4];
  clear(sums[0]);
  clear(sums[1]);
  float bias[2] = {};
  Fetched next_x, next_dz;
  next_x.load(x, in_columns, place.in0, first, end);
  next_dz.load(dz, call.x.width, place.out0, first, end);
  for (std::int64_t row0 = first; row0 < end; row0 += kTile) {
    __syncthreads();
    next_x.store(x_tile);
    next_dz.store(dz_tile);
    __syncthreads();
    if (row0 + kTile < end) {  // on their way while this tile is summed
      next_x.load(x, in_columns, place.in0, row0 + kTile, end);
      next_dz.load(dz, call.x.width, place.out0, row0 + kTile, end);
    }
#pragma unroll
    for (int row = 0; row < kTile; row += kGroup) {
      const Fragment d[2] = {outputs<kTilePitch>(lane, dz_tile, row, out),
                             outputs<kTilePitch>(lane, dz_tile, row, out + kGroup)};
#pragma unroll
      for (int m = 0; m < 2; ++m) {
        const Fragment from = inputs<kTilePitch>(lane, x_tile, row, in + m * kGroup);
#pragma unroll
        for (int n = 0; n < 2; ++n) {
          multiply_add(sums[m][2 * n], from, d[n].reg[0], d[n].reg[1]);
          multiply_add(sums[m][2 * n + 1], from, d[n].reg[2], d[n].reg[3]);
        }
      }
      // Warps 0 and 1 hold the same outputs, and so do 2 and 3: each sums 16 of them.
      const Fragment mine = warp % 2 == 0 ? d[0] : d[1];
      bias[0] += column_sum(mine.reg[0], mine.reg[1]);
      bias[1] += column_sum(mine.reg[2], mine.reg[3]);
    }
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
__global__ void __launch_bounds__(kSumColumns* kSumSegments) sum_kernel(const Call call) {
  const std::int64_t element = static_cast<std::int64_t>(blockIdx.x) * kSumColumns + threadIdx.x;
  const std::int64_t rows = live_count(call.live, call.x.rows);
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

}  // namespace

void feature_weight_gradients(const LayersOf<float>& d, const Activations& x, const __nv_bfloat16* dz,
                              const std::int32_t* live, Workspace& arena) {
  Call call{d, x, dz, live};
  call.rows_a_range = std::max(kFewestRows, (x.rows + kMostRanges - 1) / kMostRanges);
  int tiles = 0;
  for (int l = 0; l < d.count; ++l) {
    const View<float>& weight = d.weight[l];
    call.start[l + 1] = call.start[l] + (weight.rows + 1) * weight.cols;
    tiles += tiles_of(static_cast<int>(weight.rows)) * tiles_of(weight.cols);
  }
  const std::int64_t ranges = (x.rows + call.rows_a_range - 1) / call.rows_a_range;
  call.partial = arena.take<float>(ranges, static_cast<std::int32_t>(call.start[d.count])).data;
  partial_kernel<<<dim3(static_cast<unsigned>(ranges), static_cast<unsigned>(tiles)), kThreads, 0, launch().stream>>>(
      call);
  check_launch("small network: weight gradients of a feature");
  sum_kernel<<<blocks_of(call.start[d.count], kSumColumns), dim3(kSumColumns, kSumSegments), 0, launch().stream>>>(
      call);
  check_launch("small network: sum of the ranges");
}

}  // namespace semfield::cuda::tiny
