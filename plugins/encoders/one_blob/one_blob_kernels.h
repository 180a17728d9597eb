// What the kernels of the one-blob encoder know, and their formulas.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "core/view.h"
#include "plugin/row_encoder.h"

namespace semfield {

/// Whether the coordinate is where the encoding has a slope: on a clamped axis it has none.
SEMFIELD_HD inline bool one_blob_inside(double x) { return x >= 0 && x <= 1; }

/// Where a coordinate lies, counted in bins: k x = bin + rest.
template <class Real>
struct BlobPlace {
  std::int32_t bin;
  Real rest;  // 0..1
};

/// Split in float64, so that only the place within a bin is rounded and 64 bins are as accurate as 2.
template <class Real>
SEMFIELD_HD inline BlobPlace<Real> blob_place(double x, std::int32_t bins) {
  const double place = bins * clamp_unit(x);
  const double whole = std::floor(place);
  return {static_cast<std::int32_t>(whole), static_cast<Real>(place - whole)};
}

/// z_b = (b + 1/2) - k x: from the coordinate to the middle of bin b, in bins, which are standard deviations.
template <class Real>
SEMFIELD_HD inline Real blob_distance(std::int32_t b, BlobPlace<Real> place) {
  return (static_cast<Real>(b - place.bin) + Real(0.5)) - place.rest;
}

/// Constants of exp(-u) = 2^n e^r, n = rint(-u / ln 2), |r| <= ln 2 / 2. ln 2 is kept as a sum whose first part has
/// zeros at its end, so that n times it is exact.
template <class Real>
struct BlobExp;
template <>
struct BlobExp<float> {
  using Bits = std::int32_t;
  static constexpr int kFraction = 23, kBias = 127;
  static constexpr float kLimit = 87;         // exp(-88) would be subnormal
  static constexpr float kRound = 0x1.8p23f;  // adding it rounds to the nearest integer, kept in the low bits
  static constexpr float kLog2e = 0x1.715476p0f, kLn2High = 0x1.62e4p-1f, kLn2Low = 0x1.7f7d1cp-20f;
};
template <>
struct BlobExp<double> {
  using Bits = std::int64_t;
  static constexpr int kFraction = 52, kBias = 1023;
  static constexpr double kLimit = 708;
  static constexpr double kRound = 0x1.8p52;
  static constexpr double kLog2e = 0x1.71547652b82fep0, kLn2High = 0x1.62e42feep-1, kLn2Low = 0x1.a39ef35793c76p-33;
};

/// e^r on [-ln 2 / 2, ln 2 / 2]: Taylor polynomial whose first dropped term is below a quarter of Real's last bit.
SEMFIELD_HD inline float exp_near_zero(float r) {
  float p = 1.f / 5040;
  p = 1.f / 720 + r * p;
  p = 1.f / 120 + r * p;
  p = 1.f / 24 + r * p;
  p = 1.f / 6 + r * p;
  p = 0.5f + r * p;
  return 1.f + (r + r * (r * p));
}
SEMFIELD_HD inline double exp_near_zero(double r) {
  double p = 1.0 / 6227020800;
  p = 1.0 / 479001600 + r * p;
  p = 1.0 / 39916800 + r * p;
  p = 1.0 / 3628800 + r * p;
  p = 1.0 / 362880 + r * p;
  p = 1.0 / 40320 + r * p;
  p = 1.0 / 5040 + r * p;
  p = 1.0 / 720 + r * p;
  p = 1.0 / 120 + r * p;
  p = 1.0 / 24 + r * p;
  p = 1.0 / 6 + r * p;
  p = 0.5 + r * p;
  return 1.0 + (r + r * (r * p));
}

/// y_b = exp(-z_b^2 / 2): the Gaussian of standard deviation 1 / k [Mueller19 Sec. 4.3], 1 at its top. The paper
/// discretises the kernel into the bins; here it is read at their middles. Values that would be subnormal are 0.
/// Branch-free: loops over it vectorise.
template <class Real>
SEMFIELD_HD inline Real blob_value(Real z) {
  using E = BlobExp<Real>;
  const Real u = Real(0.5) * z * z;
  const Real x = u < E::kLimit ? -u : -E::kLimit;
  const Real shifted = x * E::kLog2e + E::kRound;
  const Real n = shifted - E::kRound;
  const Real r = (x - n * E::kLn2High) - n * E::kLn2Low;
  const auto exponent =
      std::bit_cast<typename E::Bits>(shifted) - std::bit_cast<typename E::Bits>(E::kRound) + E::kBias;  // n + bias
  const Real scale = std::bit_cast<Real>(static_cast<typename E::Bits>(exponent << E::kFraction));
  return u < E::kLimit ? exp_near_zero(r) * scale : Real(0);
}

/// z_b y_b; the slope is dy_b/dx = k z_b y_b.
template <class Real>
SEMFIELD_HD inline Real blob_slope(Real z) {
  return z * blob_value(z);
}

/// Coordinates of an input row, and most bins of one.
inline constexpr std::int32_t kOneBlobDims = 3;
inline constexpr std::int32_t kOneBlobMaxBins = 64;

struct OneBlobShape {
  std::int32_t bins = 16;
};

void one_blob_kernels(KernelTables& tables);

}  // namespace semfield
