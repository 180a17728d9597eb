// CUDA kernels of the one-blob encoder: forward takes up to four neighbouring bins a thread, backward eight threads a
// coordinate, so that rows are written and read as whole stretches.
#include <cstdint>

#include "cuda/kernels/device_code.cuh"
#include "encoders/one_blob/one_blob_kernels.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kBlockRows = 32;
constexpr int kLanes = 8;  // of a coordinate in backward: 32 bytes of dy at a time

/// A thread writes kBins neighbouring bins of one coordinate, 4 as one store of 16 bytes. A row: 24 bytes read, 12 bins
/// written.
template <int kBins>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(std::int32_t bins, View<const double> x, View<float> y, FaultKey* fault) {
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * kBlockRows;
  const int rows = static_cast<int>(min(std::int64_t{kBlockRows}, x.rows - begin));
  const int pieces = bins / kBins;  // of a coordinate
  for (int i = static_cast<int>(threadIdx.x); i < rows * kOneBlobDims * pieces; i += kThreads) {
    const int coordinate = i / pieces, first = i % pieces * kBins;
    const int c = coordinate % kOneBlobDims;
    const std::int64_t row = begin + coordinate / kOneBlobDims;
    const double at = x(row, c);
    if (first == 0 && !isfinite(at)) note_fault(fault, Stage::encoded_position, row);
    const BlobPlace<float> place = blob_place<float>(at, bins);
    float* const to = y.row(row) + c * bins + first;
    if constexpr (kBins == 4) {
      *reinterpret_cast<float4*>(to) =
          make_float4(blob_value(blob_distance(first, place)), blob_value(blob_distance(first + 1, place)),
                      blob_value(blob_distance(first + 2, place)), blob_value(blob_distance(first + 3, place)));
    } else {
      *to = blob_value(blob_distance(first, place));
    }
  }
}

/// kLanes threads a coordinate: each sums every kLanes-th bin in double, lowest first, then their sums are added in a
/// fixed tree. All threads of a warp reach the tree. A row: 24 + 12 bins bytes read, 12 written.
__global__ void __launch_bounds__(kThreads)
    backward_kernel(std::int32_t bins, View<const double> x, View<const float> dy, View<float> dx) {
  const std::int64_t coordinate = (static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kLanes;
  const int lane = static_cast<int>(threadIdx.x) % kLanes;
  const std::int64_t row = coordinate / kOneBlobDims;
  const auto c = static_cast<std::int32_t>(coordinate % kOneBlobDims);
  const bool wanted = row < x.rows;
  const double at = wanted ? x(row, c) : 0;
  const BlobPlace<float> place = blob_place<float>(at, bins);
  double sum = 0;
  if (wanted) {
    const float* const from = dy.row(row) + c * bins;
    for (int b = lane; b < bins; b += kLanes) {
      sum += static_cast<double>(from[b]) * static_cast<double>(blob_slope(blob_distance(b, place)));
    }
  }
  for (int offset = kLanes / 2; offset > 0; offset /= 2) sum += __shfl_xor_sync(kFullMask, sum, offset);
  if (wanted && lane == 0) dx(row, c) = one_blob_inside(at) ? static_cast<float>(bins * sum) : 0.F;
}

/// Whether every four neighbouring bins lie on a 16-byte boundary.
bool in_fours(std::int32_t bins, View<float> y) {
  return bins % 4 == 0 && y.row_stride % 4 == 0 && reinterpret_cast<std::uintptr_t>(y.data) % 16 == 0;
}

std::int64_t forward(const OneBlobShape& shape, View<const double> x, View<float> y) {
  if (x.rows == 0) return -1;
  const unsigned blocks = blocks_of(x.rows, kBlockRows);
  if (in_fours(shape.bins, y)) {
    forward_kernel<4><<<blocks, kThreads, 0, launch().stream>>>(shape.bins, x, y, launch().fault);
  } else {
    forward_kernel<1><<<blocks, kThreads, 0, launch().stream>>>(shape.bins, x, y, launch().fault);
  }
  check_launch("one-blob forward");
  return first_fault_row(Stage::encoded_position);
}

void backward(const OneBlobShape& shape, View<const double> x, View<const float> dy, View<float> dx) {
  if (x.rows == 0) return;
  backward_kernel<<<blocks_of(x.rows * kOneBlobDims * kLanes, kThreads), kThreads, 0, launch().stream>>>(shape.bins, x,
                                                                                                         dy, dx);
  check_launch("one-blob backward");
}

const RowKernels<float, OneBlobShape> kTable{forward, backward};

}  // namespace

void one_blob_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'one_blob'", &kTable); }

}  // namespace semfield::cuda
