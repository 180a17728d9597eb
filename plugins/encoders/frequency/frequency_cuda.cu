// CUDA kernels of the frequency encoder: a block builds a tile of rows in shared memory, so that what goes to and comes
// from device memory is whole stretches of rows.
#include <algorithm>

#include "cuda/kernels/device_code.cuh"
#include "encoders/frequency/frequency_kernels.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 192;  // 64 rows of 3 coordinates, one each
constexpr int kMostRowsLog2 = 6;
constexpr int kTileFloats = 12'288;  // 48 KB, what a block gets unasked; 8 rows of kFrequencyMaxDims and 40 bands fit

/// A block's rows in shared memory.
struct Tile {
  int rows_log2 = 0;
  std::int32_t stride = 0;  ///< floats between rows: odd, so that neighbouring rows lie in different banks
  bool flat = false;        ///< the tile lies in device memory as it lies here, on 16-byte boundaries
  std::size_t bytes() const { return (sizeof(float) * static_cast<std::size_t>(stride)) << rows_log2; }
};

template <class T>
Tile tile_for(View<T> y) {
  Tile tile;
  tile.stride = y.cols | 1;
  tile.rows_log2 = kMostRowsLog2;
  while ((tile.stride << tile.rows_log2) > kTileFloats) --tile.rows_log2;
  tile.flat = y.contiguous() && y.cols == tile.stride && reinterpret_cast<std::uintptr_t>(y.data) % 16 == 0;
  return tile;
}

/// Calls move(shared, device) for every number of rows [begin, begin + rows) of y; move4 for four at once. A warp moves
/// consecutive numbers: 512 or 128 bytes at a time.
template <class T, class Move, class Move4>
__device__ void for_tile(const Tile& tile, View<T> y, std::int64_t begin, int rows, float4* shared, const Move& move,
                         const Move4& move4) {
  auto* const here = reinterpret_cast<float*>(shared);
  T* const there = y.row(begin);
  if (tile.flat) {
    const int count = rows * tile.stride;
    for (int i = static_cast<int>(threadIdx.x); i < count / 4; i += kThreads) move4(shared + i, there + 4 * i);
    for (int i = count / 4 * 4 + static_cast<int>(threadIdx.x); i < count; i += kThreads) move(here + i, there + i);
    return;
  }
  for (int r = static_cast<int>(threadIdx.x) / kWarp; r < rows; r += kThreads / kWarp) {
    for (int c = static_cast<int>(threadIdx.x) % kWarp; c < y.cols; c += kWarp) {
      move(here + r * tile.stride + c, there + r * y.row_stride + c);
    }
  }
}

/// A coordinate with its phase; one that cannot be encoded counts as 0.
struct Coordinate {
  double x;
  Turns phase;
  bool sound;
};

__device__ inline Coordinate coordinate_of(const FrequencyShape& shape, double x) {
  if (shape.arithmetic != Arithmetic::float64) x = static_cast<double>(static_cast<float>(x));
  const bool sound = fabs(x) <= kFrequencyLimit;  // false for NaN
  if (!sound) x = 0;
  return {x, turns_of(x, shape.angular), sound};
}

__device__ inline void band(const FrequencyShape& shape, const Coordinate& at, double scale, float& sine,
                            float& cosine) {
  if (shape.arithmetic == Arithmetic::naive) {
    sincos_of_turns<float>(naive_turns_of(at.x, angular_factor(shape.angular) * scale), 1.0, sine, cosine);
  } else {
    sincos_of_turns<float>(at.phase, scale, sine, cosine);
  }
}

/// One thread a coordinate of a row, over its bands; then the block writes the tile. A row: 8 D bytes read, 4 cols
/// written.
__global__ void __launch_bounds__(kThreads)
    forward_kernel(FrequencyShape shape, Tile tile, View<const double> x, View<float> y, FaultKey* fault) {
  extern __shared__ float4 shared[];
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) << tile.rows_log2;
  const int rows = static_cast<int>(min(std::int64_t{1} << tile.rows_log2, x.rows - begin));
  for (int i = static_cast<int>(threadIdx.x); i < shape.dims << tile.rows_log2; i += kThreads) {
    const int r = i & ((1 << tile.rows_log2) - 1), c = i >> tile.rows_log2;
    if (r >= rows) continue;
    const Coordinate at = coordinate_of(shape, x(begin + r, c));
    if (!at.sound) note_fault(fault, Stage::encoded_position, begin + r);
    float* to = reinterpret_cast<float*>(shared) + r * tile.stride + c;
    if (shape.include_input) {
      *to = at.sound ? static_cast<float>(x(begin + r, c)) : 0.F;
      to += shape.dims;
    }
    double scale = 1;
#pragma unroll 2
    for (int k = 0; k < shape.frequencies; ++k, scale *= 2, to += 2 * shape.dims) {
      band(shape, at, scale, to[0], to[shape.dims]);
    }
  }
  __syncthreads();
  for_tile(
      tile, y, begin, rows, shared, [](const float* here, float* there) { *there = *here; },
      [](const float4* here, float* there) { *reinterpret_cast<float4*>(there) = *here; });
}

/// As forward_kernel: the block reads the tile of dy, then one thread a coordinate sums over bands in double, lowest
/// first. A row: 8 D + 4 cols bytes read, 4 D written.
__global__ void __launch_bounds__(kThreads)
    backward_kernel(FrequencyShape shape, Tile tile, View<const double> x, View<const float> dy, View<float> dx) {
  extern __shared__ float4 shared[];
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) << tile.rows_log2;
  const int rows = static_cast<int>(min(std::int64_t{1} << tile.rows_log2, x.rows - begin));
  for_tile(
      tile, dy, begin, rows, shared, [](float* here, const float* there) { *here = *there; },
      [](float4* here, const float* there) { *here = *reinterpret_cast<const float4*>(there); });
  __syncthreads();
  for (int i = static_cast<int>(threadIdx.x); i < shape.dims << tile.rows_log2; i += kThreads) {
    const int r = i & ((1 << tile.rows_log2) - 1), c = i >> tile.rows_log2;
    if (r >= rows) continue;
    const Coordinate at = coordinate_of(shape, x(begin + r, c));
    const float* from = reinterpret_cast<const float*>(shared) + r * tile.stride + c;
    double sum = 0;
    if (shape.include_input) {
      sum = *from;
      from += shape.dims;
    }
    double scale = 1;
#pragma unroll 2
    for (int k = 0; k < shape.frequencies; ++k, scale *= 2, from += 2 * shape.dims) {
      float sine, cosine;
      band(shape, at, scale, sine, cosine);
      sum += angular_factor(shape.angular) * scale *
             (static_cast<double>(from[0]) * cosine - static_cast<double>(from[shape.dims]) * sine);
    }
    dx(begin + r, c) = static_cast<float>(sum);
  }
}

std::int64_t forward(const FrequencyShape& shape, View<const double> x, View<float> y) {
  if (x.rows == 0 || y.cols == 0) return -1;
  const Tile tile = tile_for(y);
  forward_kernel<<<blocks_of(x.rows, 1 << tile.rows_log2), kThreads, tile.bytes(), launch().stream>>>(shape, tile, x, y,
                                                                                                      launch().fault);
  check_launch("frequency forward");
  return first_fault_row(Stage::encoded_position);
}

void backward(const FrequencyShape& shape, View<const double> x, View<const float> dy, View<float> dx) {
  if (x.rows == 0) return;
  const Tile tile = tile_for(dy);
  backward_kernel<<<blocks_of(x.rows, 1 << tile.rows_log2), kThreads, tile.bytes(), launch().stream>>>(shape, tile, x,
                                                                                                       dy, dx);
  check_launch("frequency backward");
}

const RowKernels<float, FrequencyShape> kTable{forward, backward};

}  // namespace

void frequency_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'frequency'", &kTable); }

}  // namespace semfield::cuda
