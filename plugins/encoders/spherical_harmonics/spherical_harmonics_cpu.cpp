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

/// Number of bands known to the compiler: the recurrences unroll to straight code.
template <class Real, std::int32_t kDegree>
std::int64_t forward_rows(const HarmonicNorms<Real>& norms, View<const double> x, View<Real> y) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    const double* d = x.row(r);
    const double off = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - 1;
    if (!(std::fabs(off) <= kUnitTolerance)) return r;  // written so that NaN is refused
    HarmonicFactors<Real> f{};
    harmonic_factors<Real>(kDegree, static_cast<Real>(d[0]), static_cast<Real>(d[1]), static_cast<Real>(d[2]), f);
    harmonics(norms, kDegree, f, y.row(r));
  }
  return -1;
}

template <class Real>
std::int64_t forward(const HarmonicShape<Real>& shape, View<const double> x, View<Real> y) {
  switch (shape.degree) {
    case 1:
      return forward_rows<Real, 1>(shape.norms, x, y);
    case 2:
      return forward_rows<Real, 2>(shape.norms, x, y);
    case 3:
      return forward_rows<Real, 3>(shape.norms, x, y);
    case 4:
      return forward_rows<Real, 4>(shape.norms, x, y);
    default:
      return forward_rows<Real, 5>(shape.norms, x, y);
  }
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
