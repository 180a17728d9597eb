#include "compute/math_functions.h"

#include "compute/isa.h"

namespace semfield {

template <class Real>
void exp_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().exp_inplace(x, n);
}

template <class Real>
void expm1_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().expm1_inplace(x, n);
}

template <class Real>
void sigmoid_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().sigmoid_inplace(x, n);
}

template <class Real>
void softplus_inplace(Real* x, std::int64_t n) {
  cpu_kernels<Real>().softplus_inplace(x, n);
}

template <class Real>
void sine_inplace(Real* z, std::int64_t n, Real frequency, Real* slope) {
  cpu_kernels<Real>().sine_inplace(z, n, frequency, slope);
}

template <class Real>
Real largest_of(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().largest_of(x, n);
}

template <class Real>
bool all_finite(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().all_finite(x, n);
}

template <class Real>
double sum_of(const Real* x, std::int64_t n) {
  return cpu_kernels<Real>().sum_of(x, n);
}

SEMFIELD_ROWS_OF(, float)
SEMFIELD_ROWS_OF(, double)
template void exp_inplace<float>(float*, std::int64_t);
template void exp_inplace<double>(double*, std::int64_t);
template void expm1_inplace<float>(float*, std::int64_t);
template void expm1_inplace<double>(double*, std::int64_t);
template void sigmoid_inplace<float>(float*, std::int64_t);
template void sigmoid_inplace<double>(double*, std::int64_t);
template void softplus_inplace<float>(float*, std::int64_t);
template void softplus_inplace<double>(double*, std::int64_t);
template void sine_inplace<float>(float*, std::int64_t, float, float*);
template void sine_inplace<double>(double*, std::int64_t, double, double*);

}  // namespace semfield
