// Elementary functions of networks and rendering: scalar forms, and loops over arrays that vectorise.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

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
void exp_inplace(Real* x, std::int64_t n);

/// x[i] = e^x[i] - 1 with small relative error everywhere (float: at most 2.4e-7), exactly 0 at 0, -1 for very negative
/// x.
template <class Real>
void expm1_inplace(Real* x, std::int64_t n);

/// x[i] = sigmoid(x[i]).
template <class Real>
void sigmoid_inplace(Real* x, std::int64_t n);

/// x[i] = softplus(x[i]) with small relative error everywhere (float: at most 4e-7).
template <class Real>
void softplus_inplace(Real* x, std::int64_t n);

/// z[i] = sin(frequency z[i]) and, where it is given, slope[i] = frequency cos(frequency z[i]): the derivative. The
/// absolute error of the sine is some 1e-7 (float) and 1e-16 |frequency z| (both). NaN where z is not finite.
template <class Real>
void sine_inplace(Real* z, std::int64_t n, Real frequency, Real* slope);

/// Largest of x[0..n), n >= 1; NaN is passed over unless all are.
template <class Real>
Real largest_of(const Real* x, std::int64_t n);

/// Neither NaN nor infinite, each of them.
template <class Real>
bool all_finite(const Real* x, std::int64_t n);

/// Sum in double, in a fixed order that is not that of the elements.
template <class Real>
double sum_of(const Real* x, std::int64_t n);

extern template void exp_inplace<float>(float*, std::int64_t);
extern template void exp_inplace<double>(double*, std::int64_t);
extern template void expm1_inplace<float>(float*, std::int64_t);
extern template void expm1_inplace<double>(double*, std::int64_t);
extern template void sigmoid_inplace<float>(float*, std::int64_t);
extern template void sigmoid_inplace<double>(double*, std::int64_t);
extern template void softplus_inplace<float>(float*, std::int64_t);
extern template void softplus_inplace<double>(double*, std::int64_t);
extern template void sine_inplace<float>(float*, std::int64_t, float, float*);
extern template void sine_inplace<double>(double*, std::int64_t, double, double*);

#define SEMFIELD_ROWS_OF(prefix, Real)                              \
  prefix template Real largest_of<Real>(const Real*, std::int64_t); \
  prefix template bool all_finite<Real>(const Real*, std::int64_t); \
  prefix template double sum_of<Real>(const Real*, std::int64_t);
SEMFIELD_ROWS_OF(extern, float)
SEMFIELD_ROWS_OF(extern, double)

}  // namespace semfield
