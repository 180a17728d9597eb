// Elementwise loops of networks and rendering, and the matrix product in the precision of its operands, for one
// instruction set. Exponentials: exact reduction to |r| <= ln2/2, a degree-7 series, scaling by exponent bits.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>

#include "compute/gemm_tiles.h"
#include "compute/isa.h"
#include "compute/math_functions.h"

namespace semfield::SEMFIELD_ISA {

void fill_cpu_kernels(CpuKernels<float>& kernels);
void fill_cpu_kernels(CpuKernels<double>& kernels);

namespace {

// ln 2 = kLn2High + kLn2Low; the high part has 15 bits, so n * kLn2High is exact for |n| < 512.
constexpr float kLog2e = 1.44269504088896341f;
constexpr float kLn2High = 0.693145751953125f;
constexpr float kLn2Low = 1.42860677e-6f;
constexpr float kRound =
    12582912.0f;  // 1.5 * 2^23: adding it rounds to the nearest integer and leaves that in the low bits

struct Reduced {
  float r;  // x - n ln2
  std::int32_t n;
};

// Callers clamp x to [-105, 89] first.
inline Reduced reduce(float x) {
  const float shifted = x * kLog2e + kRound;
  const float n = shifted - kRound;
  return {(x - n * kLn2High) - n * kLn2Low, std::bit_cast<std::int32_t>(shifted) - std::bit_cast<std::int32_t>(kRound)};
}

/// e^r - 1 = r + r^2 (1/2! + r/3! + ... + r^5/7!); the next term is below 6e-9 on |r| <= ln2/2.
inline float expm1_series(float r) {
  float q = 1.0f / 5040.0f;
  q = q * r + 1.0f / 720.0f;
  q = q * r + 1.0f / 120.0f;
  q = q * r + 1.0f / 24.0f;
  q = q * r + 1.0f / 6.0f;
  q = q * r + 0.5f;
  return r + (r * r) * q;
}

inline float power_of_two(std::int32_t n) { return std::bit_cast<float>((n + 127) << 23); }

// Comparisons are written so that NaN passes through the clamps.
inline float clamp_exponent(float x, float low) {
  x = x < low ? low : x;
  return x > 89.0f ? 89.0f : x;
}

inline float exp_value(float x) {
  const Reduced v = reduce(clamp_exponent(x, -105.0f));
  // 2^n in two factors: the first product stays normal, the second rounds into subnormals or overflows to infinity.
  const std::int32_t half = v.n >> 1;
  return (1.0f + expm1_series(v.r)) * power_of_two(half) * power_of_two(v.n - half);
}

inline float expm1_value(float x) {
  const Reduced v = reduce(clamp_exponent(x, -30.0f));
  // 2^n e^r - 1 = 2 (2^(n-1) (e^r - 1) + (2^(n-1) - 1/2)): 2^(n-1) is finite up to n = 128.
  const float scale = power_of_two(v.n - 1);
  return 2.0f * (scale * expm1_series(v.r) + (scale - 0.5f));
}

// log1p(e) = 2 atanh(s) with s = e / (2 + e) <= 1/3: an odd series without any reduction; the next term is below 2e-9
// of the sum.
inline float softplus_value(float x) {
  const float e = exp_value(-std::abs(x));
  const float s = e / (2.0f + e), q = s * s;
  float p = 1.0f / 15.0f;
  p = p * q + 1.0f / 13.0f;
  p = p * q + 1.0f / 11.0f;
  p = p * q + 1.0f / 9.0f;
  p = p * q + 1.0f / 7.0f;
  p = p * q + 1.0f / 5.0f;
  p = p * q + 1.0f / 3.0f;
  return (x > 0.0f ? x : 0.0f) + 2.0f * (s + s * (q * p));
}

// The oracle's.
inline double exp_value(double x) { return std::exp(x); }
inline double expm1_value(double x) { return std::expm1(x); }
inline double softplus_value(double x) { return (x > 0.0 ? x : 0.0) + std::log1p(std::exp(-std::abs(x))); }

template <class Real>
void exp_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) x[i] = exp_value(x[i]);
}
template <class Real>
void expm1_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) x[i] = expm1_value(x[i]);
}
template <class Real>
void sigmoid_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) {
    const Real e = exp_value(-std::abs(x[i]));
    x[i] = (x[i] < Real(0) ? e : Real(1)) / (Real(1) + e);
  }
}
template <class Real>
void softplus_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) x[i] = softplus_value(x[i]);
}

template <class Real>
void sine_inplace(Real* z, std::int64_t n, Real frequency, Real* slope) {
  const double scale = static_cast<double>(frequency) * 0.15915494309189535;  // 1 / (2 pi)
  for (std::int64_t i = 0; i < n; ++i) {
    double turns = static_cast<double>(z[i]) * scale;
    turns -= std::rint(turns);
    Real cosine;
    sincos_of_quarters(4.0 * turns, z[i], cosine);
    if (slope != nullptr) slope[i] = frequency * cosine;
  }
}

// Lanes that a reduction keeps apart, the same for every instruction set: the compiler may not reorder sums itself.
constexpr std::int64_t kApart = 16;

template <class Real>
Real largest_of(const Real* x, std::int64_t n) {
  // From below every number, so that a NaN at the beginning does not stay.
  constexpr Real kLeast = -std::numeric_limits<Real>::infinity();
  Real most[kApart];
  for (Real& value : most) value = kLeast;
  std::int64_t k = 0;
  for (; k + kApart <= n; k += kApart) {
    for (std::int64_t i = 0; i < kApart; ++i) most[i] = x[k + i] > most[i] ? x[k + i] : most[i];
  }
  for (; k < n; ++k) most[k % kApart] = x[k] > most[k % kApart] ? x[k] : most[k % kApart];
  Real result = most[0];
  for (std::int64_t i = 1; i < kApart; ++i) result = most[i] > result ? most[i] : result;
  if (result > kLeast) return result;
  for (k = 0; k < n; ++k) {
    if (x[k] == kLeast) return kLeast;
  }
  return x[0];  // NaN throughout
}

template <class Real>
bool all_finite(const Real* x, std::int64_t n) {
  int bad = 0;
  for (std::int64_t k = 0; k < n; ++k) bad |= x[k] - x[k] == Real(0) ? 0 : 1;  // inf - inf and NaN are not 0
  return bad == 0;
}

template <class Real>
double sum_of(const Real* x, std::int64_t n) {
  double part[kApart] = {};
  std::int64_t k = 0;
  for (; k + kApart <= n; k += kApart) {
    for (std::int64_t i = 0; i < kApart; ++i) part[i] += static_cast<double>(x[k + i]);
  }
  for (; k < n; ++k) part[k % kApart] += static_cast<double>(x[k]);
  double sum = 0;
  for (const double p : part) sum += p;
  return sum;
}

template <class Real>
void relu_backward(View<const Real> y, View<Real> dy) {
  for (std::int64_t m = 0; m < dy.rows; ++m) {
    const Real* value = y.row(m);
    Real* grad = dy.row(m);
    for (std::int32_t n = 0; n < dy.cols; ++n) grad[n] = value[n] > Real(0) ? grad[n] : Real(0);
  }
}

template <class Real>
void bias_backward(View<const Real> dz, View<Real> d_bias) {
  // 64 columns at a time stay in registers while the rows pass by.
  constexpr std::int32_t kWidth = 64;
  for (std::int32_t first = 0; first < dz.cols; first += kWidth) {
    const std::int32_t width = std::min(kWidth, dz.cols - first);
    Real* target = d_bias.data + first;
    Real sum[kWidth] = {};
    std::memcpy(sum, target, sizeof(Real) * static_cast<std::size_t>(width));
    if (width == kWidth) {
      for (std::int64_t m = 0; m < dz.rows; ++m) {
        const Real* row = dz.row(m) + first;
        for (std::int32_t n = 0; n < kWidth; ++n) sum[n] += row[n];
      }
    } else {
      for (std::int64_t m = 0; m < dz.rows; ++m) {
        const Real* row = dz.row(m) + first;
        for (std::int32_t n = 0; n < width; ++n) sum[n] += row[n];
      }
    }
    std::memcpy(target, sum, sizeof(Real) * static_cast<std::size_t>(width));
  }
}

template <class Real>
void per_ray_backward(View<const Real> dz, View<const std::int32_t> ray_of_sample, View<Real> d_ray_term) {
  for (std::int64_t r = 0; r < d_ray_term.rows; ++r) std::fill_n(d_ray_term.row(r), d_ray_term.cols, Real(0));
  for (std::int64_t m = 0; m < dz.rows; ++m) {
    const Real* row = dz.row(m);
    Real* sum = d_ray_term.row(ray_of_sample(m, 0));
    for (std::int32_t n = 0; n < dz.cols; ++n) sum[n] += row[n];
  }
}

// The matrix product.

// Rows of B per block: the packed panel (kBlockK x kMaxVecs vectors, 64 KiB at 64-byte vectors) streams from L2 once a
// tile.
constexpr std::int64_t kBlockK = 256;

/// Columns [col, col + cols) of C, rows k0 .. k0+count of B: the panel of B is packed to contiguous, zero-padded rows.
template <class Real>
void panel(const Gemm<Real>& g, std::int64_t col, int cols, std::int64_t k0, std::int64_t count) {
  using Op = MultiplyAdd<Real>;
  alignas(64) Real packed[kBlockK * kMaxVecs * kLanesOf<Op>];
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  const Cover<Op> shape = cover_of<Op>(cols, transposed);
  const int width = shape.width;
  const Real* b = g.b + k0 * g.b_row + col;
  std::int64_t b_row = g.b_row;
  // Packing costs one copy of the panel: worth it when several tiles read it, needed when its last vector is partial.
  if (b_row != width && (cols != width || g.m >= 2 * shape.rows)) {
    for (std::int64_t k = 0; k < count; ++k) {
      Real* row = packed + k * width;
      std::memcpy(row, b + k * b_row, sizeof(Real) * static_cast<std::size_t>(cols));
      for (int i = cols; i < width; ++i) row[i] = Real(0);
    }
    b = packed;
    b_row = width;
  }
  Real strip[kMaxRows * kBlockK];  // rows of A when neither of its strides is 1
  TileArgs<Op> t{};
  t.b = b;
  t.b_row = b_row;
  t.k = count;
  t.cols = cols;
  run_tiles(g, shape, t, 0, g.m, col, k0, count, [&](std::int64_t row, int rows) {
    t.a = g.a + row * g.a_row + k0 * g.a_col;
    t.a_step = transposed ? g.a_col : g.a_row;
    if (transposed || g.a_col == 1) return;
    for (int i = 0; i < rows; ++i) {
      for (std::int64_t k = 0; k < count; ++k) strip[i * kBlockK + k] = t.a[i * g.a_row + k * g.a_col];
    }
    t.a = strip;
    t.a_step = kBlockK;
  });
}

template <class Real>
void gemm(const Gemm<Real>& g) {
  constexpr std::int64_t kPanel = kMaxVecs * kLanesOf<MultiplyAdd<Real>>;
  for (std::int64_t col = 0; col < g.n; col += kPanel) {
    const int cols = static_cast<int>(std::min(kPanel, g.n - col));
    // With k = 0 one empty block still writes the start.
    for (std::int64_t k0 = 0; k0 == 0 || k0 < g.k; k0 += kBlockK) panel(g, col, cols, k0, std::min(kBlockK, g.k - k0));
  }
}

template <class Real>
void fill(CpuKernels<Real>& kernels) {
  kernels.gemm = gemm<Real>;
  kernels.exp_inplace = exp_inplace<Real>;
  kernels.expm1_inplace = expm1_inplace<Real>;
  kernels.sigmoid_inplace = sigmoid_inplace<Real>;
  kernels.softplus_inplace = softplus_inplace<Real>;
  kernels.sine_inplace = sine_inplace<Real>;
  kernels.largest_of = largest_of<Real>;
  kernels.all_finite = all_finite<Real>;
  kernels.sum_of = sum_of<Real>;
  kernels.relu_backward = relu_backward<Real>;
  kernels.bias_backward = bias_backward<Real>;
  kernels.per_ray_backward = per_ray_backward<Real>;
}

}  // namespace

void fill_cpu_kernels(CpuKernels<float>& kernels) { fill(kernels); }
void fill_cpu_kernels(CpuKernels<double>& kernels) { fill(kernels); }

}  // namespace semfield::SEMFIELD_ISA
