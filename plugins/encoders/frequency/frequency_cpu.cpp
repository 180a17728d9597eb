// CPU kernels of the frequency encoder: blocks of 192 coordinates, one band at a time, every inner loop vectorisable.
#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "encoders/frequency/frequency_kernels.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

constexpr std::int32_t kBlockValues = 192;  // 64 rows of 3 coordinates: phases, sines and cosines stay in the L1 cache
constexpr std::int32_t kLanes = 16;  // loops run over whole groups, so a row's bits never depend on its neighbours

/// Phases of one block of rows, flattened row by row.
struct Block {
  alignas(64) double hi[kBlockValues];
  alignas(64) double lo[kBlockValues];
  alignas(64) double x[kBlockValues];
  std::int32_t values = 0;
  std::int32_t padded = 0;
};

std::int64_t rows_per_block(const FrequencyShape& shape) { return kBlockValues / shape.dims; }

/// Fills the block with the phases of rows [begin, begin + rows); false when a coordinate cannot be encoded.
bool load_block(const FrequencyShape& shape, View<const double> x, std::int64_t begin, std::int64_t rows,
                Block& block) {
  double* flat = block.x;
  std::int32_t n = 0;
  for (std::int64_t r = 0; r < rows; ++r) {
    const double* from = x.row(begin + r);
    for (std::int32_t c = 0; c < shape.dims; ++c) flat[n++] = from[c];
  }
  block.values = n;
  block.padded = (n + kLanes - 1) / kLanes * kLanes;
  for (std::int32_t i = n; i < block.padded; ++i) flat[i] = 0;
  if (shape.arithmetic != Arithmetic::float64) {
    for (std::int32_t i = 0; i < n; ++i) flat[i] = static_cast<double>(static_cast<float>(flat[i]));
  }
  std::int32_t bad = 0;
  for (std::int32_t i = 0; i < block.padded; ++i) {
    bad |= std::fabs(flat[i]) <= kFrequencyLimit ? 0 : 1;  // written so that NaN is bad
    const Turns phase = turns_of(flat[i], shape.angular);
    block.hi[i] = phase.hi;
    block.lo[i] = phase.lo;
  }
  return bad == 0;
}

std::int64_t first_bad_row(View<const double> x) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    for (std::int32_t c = 0; c < x.cols; ++c) {
      if (!(std::fabs(x(r, c)) <= kFrequencyLimit)) return r;
    }
  }
  return -1;
}

template <class Real>
void band(const FrequencyShape& shape, const Block& block, double scale, Real* __restrict sine,
          Real* __restrict cosine) {
  if (shape.arithmetic == Arithmetic::naive) {
    const double factor = angular_factor(shape.angular) * scale;
    for (std::int32_t i = 0; i < block.padded; ++i)
      sincos_of_turns<Real>(naive_turns_of(block.x[i], factor), 1.0, sine[i], cosine[i]);
    return;
  }
  for (std::int32_t i = 0; i < block.padded; ++i) {
    sincos_of_turns<Real>({block.hi[i], block.lo[i]}, scale, sine[i], cosine[i]);
  }
}

/// `dims` known to the compiler for positions and directions; 0 = read it from the shape.
template <class Real, std::int32_t kDims>
void store_band(const FrequencyShape& shape, std::int64_t rows, const Real* sine, const Real* cosine, Real* to,
                std::int64_t stride) {
  const std::int32_t dims = kDims > 0 ? kDims : shape.dims;
  for (std::int64_t r = 0; r < rows; ++r) {
    for (std::int32_t c = 0; c < dims; ++c) to[c] = sine[r * dims + c];
    for (std::int32_t c = 0; c < dims; ++c) to[dims + c] = cosine[r * dims + c];
    to += stride;
  }
}

template <class Real>
std::int64_t forward(const FrequencyShape& shape, View<const double> x, View<Real> y) {
  Block block;
  alignas(64) Real sine[kBlockValues];
  alignas(64) Real cosine[kBlockValues];
  const std::int64_t step = rows_per_block(shape);
  const std::int32_t first = shape.include_input ? shape.dims : 0;
  for (std::int64_t begin = 0; begin < x.rows; begin += step) {
    const std::int64_t rows = std::min(step, x.rows - begin);
    if (!load_block(shape, x, begin, rows, block)) return first_bad_row(x);
    for (std::int64_t r = 0; r < rows && shape.include_input; ++r) {
      for (std::int32_t c = 0; c < shape.dims; ++c) y(begin + r, c) = static_cast<Real>(x(begin + r, c));
    }
    double scale = 1;
    for (std::int32_t k = 0; k < shape.frequencies; ++k, scale *= 2) {
      band<Real>(shape, block, scale, sine, cosine);
      Real* to = y.row(begin) + first + 2 * shape.dims * k;
      if (shape.dims == 3) {
        store_band<Real, 3>(shape, rows, sine, cosine, to, y.row_stride);
      } else {
        store_band<Real, 0>(shape, rows, sine, cosine, to, y.row_stride);
      }
    }
  }
  return -1;
}

/// dx = dy_x + sum_k a 2^k (dy_sin cos(a 2^k x) - dy_cos sin(a 2^k x)), a = 1 or pi; summed in double, lowest band
/// first.
template <class Real>
void backward_block(const FrequencyShape& shape, View<const double> x, View<const Real> dy, View<Real> dx,
                    std::int64_t begin) {
  Block block;
  alignas(64) Real sine[kBlockValues];
  alignas(64) Real cosine[kBlockValues];
  alignas(64) double sum[kBlockValues];
  const std::int64_t rows = std::min(rows_per_block(shape), x.rows - begin);
  load_block(shape, x, begin, rows, block);
  const std::int32_t dims = shape.dims;
  const std::int32_t first = shape.include_input ? dims : 0;
  for (std::int64_t r = 0; r < rows; ++r) {
    for (std::int32_t c = 0; c < dims; ++c) {
      sum[r * dims + c] = shape.include_input ? static_cast<double>(dy(begin + r, c)) : 0.0;
    }
  }
  double scale = 1;
  const double a = angular_factor(shape.angular);
  for (std::int32_t k = 0; k < shape.frequencies; ++k, scale *= 2) {
    band<Real>(shape, block, scale, sine, cosine);
    for (std::int64_t r = 0; r < rows; ++r) {
      const Real* d_sine = dy.row(begin + r) + first + 2 * dims * k;
      const Real* d_cosine = d_sine + dims;
      for (std::int32_t c = 0; c < dims; ++c) {
        const std::int64_t i = r * dims + c;
        sum[i] += a * scale * (static_cast<double>(d_sine[c]) * cosine[i] - static_cast<double>(d_cosine[c]) * sine[i]);
      }
    }
  }
  for (std::int64_t r = 0; r < rows; ++r) {
    for (std::int32_t c = 0; c < dims; ++c) dx(begin + r, c) = static_cast<Real>(sum[r * dims + c]);
  }
}

template <class Real>
void backward(const FrequencyShape& shape, View<const double> x, View<const Real> dy, View<Real> dx) {
  const std::int64_t step = rows_per_block(shape);
  parallel_for((x.rows + step - 1) / step, [&](std::int64_t i) { backward_block<Real>(shape, x, dy, dx, i * step); });
}

template <class Real>
const RowKernels<Real, FrequencyShape> kTable{forward<Real>, backward<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(frequency, "encoder 'frequency'", kTable)

}  // namespace semfield::SEMFIELD_ISA
