// CPU kernels of the one-blob encoder: one coordinate at a time, all its bins in one loop that vectorises.
#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "encoders/one_blob/one_blob_kernels.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

constexpr std::int64_t kRowsPerTask = 256;
constexpr std::int32_t kLanes = 16;  // loops run over whole groups: no bin's bits depend on how many there are

/// Bins, rounded up to whole groups.
std::int32_t padded(std::int32_t bins) { return (bins + kLanes - 1) / kLanes * kLanes; }

template <class Real>
void fill_values(double x, std::int32_t bins, Real* __restrict value) {
  const BlobPlace<Real> place = blob_place<Real>(x, bins);
  const std::int32_t count = padded(bins);
  for (std::int32_t b = 0; b < count; ++b) value[b] = blob_value(blob_distance(b, place));
}

template <class Real>
void fill_slopes(double x, std::int32_t bins, Real* __restrict slope) {
  const BlobPlace<Real> place = blob_place<Real>(x, bins);
  const std::int32_t count = padded(bins);
  for (std::int32_t b = 0; b < count; ++b) slope[b] = blob_slope(blob_distance(b, place));
}

template <class Real>
std::int64_t forward(const OneBlobShape& shape, View<const double> x, View<Real> y) {
  const std::int32_t bins = shape.bins;
  alignas(64) Real value[kOneBlobMaxBins];
  for (std::int64_t r = 0; r < x.rows; ++r) {
    Real* to = y.row(r);
    for (std::int32_t c = 0; c < kOneBlobDims; ++c, to += bins) {
      if (!std::isfinite(x(r, c))) return r;
      fill_values(x(r, c), bins, value);
      for (std::int32_t b = 0; b < bins; ++b) to[b] = value[b];
    }
  }
  return -1;
}

/// dx_c = k sum_b dy_b z_b y_b, summed in double, lowest bin first; 0 where the coordinate was clamped.
template <class Real>
void backward_row(std::int32_t bins, const double* x, const Real* dy, Real* dx) {
  alignas(64) Real slope[kOneBlobMaxBins];
  for (std::int32_t c = 0; c < kOneBlobDims; ++c, dy += bins) {
    fill_slopes(x[c], bins, slope);
    double sum = 0;
    for (std::int32_t b = 0; b < bins; ++b) sum += static_cast<double>(dy[b]) * static_cast<double>(slope[b]);
    dx[c] = one_blob_inside(x[c]) ? static_cast<Real>(bins * sum) : Real(0);
  }
}

template <class Real>
void backward(const OneBlobShape& shape, View<const double> x, View<const Real> dy, View<Real> dx) {
  parallel_for((x.rows + kRowsPerTask - 1) / kRowsPerTask, [&](std::int64_t task) {
    const std::int64_t end = std::min(x.rows, (task + 1) * kRowsPerTask);
    for (std::int64_t r = task * kRowsPerTask; r < end; ++r) {
      backward_row(shape.bins, x.row(r), dy.row(r), dx.row(r));
    }
  });
}

template <class Real>
const RowKernels<Real, OneBlobShape> kTable{forward<Real>, backward<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(one_blob, "encoder 'one_blob'", kTable)

}  // namespace semfield::SEMFIELD_ISA
