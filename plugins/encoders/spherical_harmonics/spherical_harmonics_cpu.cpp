// CPU kernels of the spherical harmonics encoder: one direction at a time (directions are encoded once per ray).
#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "encoders/spherical_harmonics/spherical_harmonics_kernels.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

constexpr std::int64_t kRowsPerTask = 256;

template <class Real>
std::int64_t forward(const HarmonicShape<Real>& shape, View<const double> x, View<Real> y) {
  return with_degree(shape.degree, [&]<std::int32_t kDegree>() {
    for (std::int64_t r = 0; r < x.rows; ++r) {
      const double* d = x.row(r);
      const double off = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - 1;
      if (!(std::fabs(off) <= kUnitTolerance)) return r;  // written so that NaN is refused
      HarmonicFactors<Real> f{};
      harmonic_factors<Real>(kDegree, static_cast<Real>(d[0]), static_cast<Real>(d[1]), static_cast<Real>(d[2]), f);
      harmonics(shape.norms, kDegree, f, y.row(r));
    }
    return std::int64_t{-1};
  });
}

template <class Real>
void backward(const HarmonicShape<Real>& shape, View<const double> x, View<const Real> dy, View<Real> dx) {
  parallel_for((x.rows + kRowsPerTask - 1) / kRowsPerTask, [&](std::int64_t task) {
    const std::int64_t end = std::min(x.rows, (task + 1) * kRowsPerTask);
    for (std::int64_t r = task * kRowsPerTask; r < end; ++r) {
      const double* d = x.row(r);
      HarmonicFactors<Real> f{};
      harmonic_factors<Real>(shape.degree, static_cast<Real>(d[0]), static_cast<Real>(d[1]), static_cast<Real>(d[2]),
                             f);
      harmonics_gradient(shape.norms, shape.degree, f, dy.row(r), dx.row(r));
    }
  });
}

template <class Real>
const RowKernels<Real, HarmonicShape<Real>> kTable{forward<Real>, backward<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(spherical_harmonics, "encoder 'spherical_harmonics'", kTable)

}  // namespace semfield::SEMFIELD_ISA
