// CUDA kernels of the spherical harmonics encoder: one thread per direction (directions are encoded once per ray, so
// there are few).
#include "cuda/kernels/device_code.cuh"
#include "encoders/spherical_harmonics/spherical_harmonics_kernels.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 64;  // 1,024 rays still occupy 16 multiprocessors

/// Factors of row `row`; where it is not a unit vector a fault is noted and the zero vector taken.
template <std::int32_t kDegree>
__device__ inline HarmonicFactors<float> factors_of(View<const double> x, std::int64_t row, FaultKey* fault) {
  const double d[3] = {x(row, 0), x(row, 1), x(row, 2)};
  const double off = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - 1;
  const bool sound = fabs(off) <= kUnitTolerance;  // false for NaN
  if (!sound) note_fault(fault, Stage::encoded_position, row);
  HarmonicFactors<float> f;
  harmonic_factors<float>(kDegree, sound ? static_cast<float>(d[0]) : 0.F, sound ? static_cast<float>(d[1]) : 0.F,
                          sound ? static_cast<float>(d[2]) : 0.F, f);
  return f;
}

/// One thread per row: 24 bytes read, 4 degree^2 written.
template <std::int32_t kDegree>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(HarmonicNorms<float> norms, View<const double> x, View<float> y, FaultKey* fault) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= x.rows) return;
  const HarmonicFactors<float> f = factors_of<kDegree>(x, row, fault);
  harmonics(norms, kDegree, f, y.row(row));
}

/// One thread per row: 24 + 4 degree^2 bytes read, 12 written.
template <std::int32_t kDegree>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(HarmonicNorms<float> norms, View<const double> x, View<const float> dy, View<float> dx) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= x.rows) return;
  const HarmonicFactors<float> f = factors_of<kDegree>(x, row, nullptr);
  harmonics_gradient(norms, kDegree, f, dy.row(row), dx.row(row));
}

std::int64_t forward(const HarmonicShape<float>& shape, View<const double> x, View<float> y) {
  if (x.rows == 0) return -1;
  with_degree(shape.degree, [&]<std::int32_t kDegree>() {
    forward_kernel<kDegree>
        <<<blocks_of(x.rows, kThreads), kThreads, 0, launch().stream>>>(shape.norms, x, y, launch().fault);
  });
  check_launch("spherical harmonics forward");
  return first_fault_row(Stage::encoded_position);
}

void backward(const HarmonicShape<float>& shape, View<const double> x, View<const float> dy, View<float> dx) {
  if (x.rows == 0) return;
  with_degree(shape.degree, [&]<std::int32_t kDegree>() {
    backward_kernel<kDegree><<<blocks_of(x.rows, kThreads), kThreads, 0, launch().stream>>>(shape.norms, x, dy, dx);
  });
  check_launch("spherical harmonics backward");
}

const RowKernels<float, HarmonicShape<float>> kTable{forward, backward};

}  // namespace

void spherical_harmonics_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "encoder 'spherical_harmonics'", &kTable);
}

}  // namespace semfield::cuda
