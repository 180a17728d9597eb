// Elementary functions of networks and rendering: scalar forms, and loops over arrays that vectorise.
#pragma once

#include <cmath>
#include <cstdint>

#include "compute/isa.h"
#include "core/view.h"

namespace semfield {

/// 1 / (1 + e^-x), from e^-|x| so that nothing overflows.
template <class Real>
SEMFIELD_HD inline Real sigmoid(Real x) {
  const Real e = std::exp(-std::abs(x));
  return (x < Real(0) ? e : Real(1)) / (Real(1) + e);
}

/// log(1 + e^x) = max(x, 0) + log1p(e^-|x|).
template <class Real>
SEMFIELD_HD inline Real softplus(Real x) {
  return (x > Real(0) ? x : Real(0)) + std::log1p(std::exp(-std::abs(x)));
}

/// x[i] = e^x[i]. float: own polynomial, at most 2 ulp, subnormal results kept, +inf above 88.73, 0 below -104; double:
/// std::exp. NaN stays NaN. An element's result does not depend on its place.
template <class Real>
void exp_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().exp_inplace(x, n);
}

/// x[i] = e^x[i] - 1 with small relative error everywhere (float: at most 2.4e-7), exactly 0 at 0, -1 for very negative
/// x.
template <class Real>
void expm1_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().expm1_inplace(x, n);
}

/// x[i] = sigmoid(x[i]).
template <class Real>
void sigmoid_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().sigmoid_inplace(x, n);
}

/// x[i] = softplus(x[i]) with small relative error everywhere (float: at most 4e-7).
template <class Real>
void softplus_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().softplus_inplace(x, n);
}

/// z[i] = sin(frequency z[i]) and, where it is given, slope[i] = frequency cos(frequency z[i]): the derivative. The
/// absolute error of the sine is some 1e-7 (float) and 1e-16 |frequency z| (both). NaN where z is not finite.
template <class Real>
void sine_inplace(Real* z, std::int64_t n, Real frequency, Real* slope) {
  cpu_kernels<Real>().sine_inplace(z, n, frequency, slope);
}

/// Largest of x[0..n), n >= 1; NaN is passed over unless all are.
template <class Real>
Real largest_of(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().largest_of(x, n);
}

/// Neither NaN nor infinite, each of them.
template <class Real>
bool all_finite(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().all_finite(x, n);
}

/// Sum in double, in a fixed order that is not that of the elements.
template <class Real>
double sum_of(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().sum_of(x, n);
}

// Sine and cosine by short polynomials on an eighth of a turn, and their reduction from quarters of a turn.

/// sin z on [-pi/4, pi/4]: Taylor polynomial whose first dropped term is below a quarter of Real's last bit.
SEMFIELD_HD inline float sine_near_zero(float z) {
  const float s = z * z;
  const float p = -1.f / 6 + s * (1.f / 120 + s * (-1.f / 5040 + s * (1.f / 362880)));
  return z + z * (s * p);
}
SEMFIELD_HD inline double sine_near_zero(double z) {
  const double s = z * z;
  double p = 1.0 / 355687428096000;
  p = -1.0 / 1307674368000 + s * p;
  p = 1.0 / 6227020800 + s * p;
  p = -1.0 / 39916800 + s * p;
  p = 1.0 / 362880 + s * p;
  p = -1.0 / 5040 + s * p;
  p = 1.0 / 120 + s * p;
  p = -1.0 / 6 + s * p;
  return z + z * (s * p);
}

/// cos z on [-pi/4, pi/4], likewise.
SEMFIELD_HD inline float cosine_near_zero(float z) {
  const float s = z * z;
  const float p = 1.f / 24 + s * (-1.f / 720 + s * (1.f / 40320 + s * (-1.f / 3628800)));
  return 1.f + s * (-0.5f + s * p);
}
SEMFIELD_HD inline double cosine_near_zero(double z) {
  const double s = z * z;
  double p = -1.0 / 6402373705728000;
  p = 1.0 / 20922789888000 + s * p;
  p = -1.0 / 87178291200 + s * p;
  p = 1.0 / 479001600 + s * p;
  p = -1.0 / 3628800 + s * p;
  p = 1.0 / 40320 + s * p;
  p = -1.0 / 720 + s * p;
  p = 1.0 / 24 + s * p;
  return 1.0 + s * (-0.5 + s * p);
}

/// sin and cos of `quarters` pi/2. Branch-free: loops over it vectorise.
template <class Real>
SEMFIELD_HD inline void sincos_of_quarters(double quarters, Real& sine, Real& cosine) {
  constexpr double half_pi = 1.5707963267948966;
  const double nearest = std::rint(quarters);
  const auto z = static_cast<Real>((quarters - nearest) * half_pi);
  const auto q = static_cast<std::int32_t>(nearest);
  const Real s = sine_near_zero(z);
  const Real c = cosine_near_zero(z);
  const Real s_turned = (q & 1) != 0 ? c : s;
  const Real c_turned = (q & 1) != 0 ? s : c;
  sine = (q & 2) != 0 ? -s_turned : s_turned;
  cosine = ((q + 1) & 2) != 0 ? -c_turned : c_turned;
}

}  // namespace semfield

// a b + c with the same bits in every loop.
namespace semfield::SEMFIELD_ISA {

/// a b + c, fused wherever the machine can. Spelled out: left to contraction, which of two products is fused may differ
/// from loop to loop and from lane to lane, and then an element's bits would depend on the place that it fell into.
template <class Real>
inline Real multiply_add(Real a, Real b, Real c) {
#if defined(__FMA__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

}  // namespace semfield::SEMFIELD_ISA
