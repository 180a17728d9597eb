// The vectorised loops of core/, compiled once per instruction set (compute/isa.h).
#pragma once

#include <cstdint>

#include "compute/gemm.h"

namespace semfield {

template <class Real>
struct CpuKernels {
  void (*gemm)(const Gemm<Real>&);
  void (*exp_inplace)(Real*, std::int64_t);
  void (*expm1_inplace)(Real*, std::int64_t);
  void (*sigmoid_inplace)(Real*, std::int64_t);
  void (*softplus_inplace)(Real*, std::int64_t);
  void (*sine_inplace)(Real* z, std::int64_t, Real frequency, Real* slope);
  Real (*largest_of)(const Real*, std::int64_t);
  bool (*all_finite)(const Real*, std::int64_t);
  double (*sum_of)(const Real*, std::int64_t);
  void (*relu_backward)(View<const Real> y, View<Real> dy);
  void (*bias_backward)(View<const Real> dz, View<Real> d_bias);
  void (*per_ray_backward)(View<const Real> dz, View<const std::int32_t> ray_of_sample, View<Real> d_ray_term);
};

/// Of the instruction set in use.
template <class Real>
const CpuKernels<Real>& cpu_kernels();

/// Whether products of bf16 run by instructions of the CPU; false: emulated, slower than fp32.
bool bf16_is_native();
/// Whether they are also faster than those of fp32: on tiles, and by the dot products of AMD's CPUs. Intel's do
/// half as many of these as fp32 multiply-adds.
bool bf16_is_faster();

extern template const CpuKernels<float>& cpu_kernels<float>();
extern template const CpuKernels<double>& cpu_kernels<double>();

}  // namespace semfield
