// Arguments and kernel table of the spherical harmonics encoder.
#pragma once

#include "core/view.h"
#include "encoders/spherical_harmonics/spherical_harmonics_math.h"

namespace semfield {

class KernelTables;

/// Largest deviation of a direction's squared length from 1.
inline constexpr double kUnitTolerance = 1e-3;

template <class Real>
struct SphericalHarmonicsKernels {
  /// Returns the first row that is not a unit vector, or -1. Runs in the calling thread.
  std::int64_t (*forward)(const HarmonicNorms<Real>& norms, std::int32_t degree, View<const double> x,
                          View<Real> y) = nullptr;
  void (*backward)(const HarmonicNorms<Real>& norms, std::int32_t degree, View<const double> x, View<const Real> dy,
                   View<Real> dx) = nullptr;
};

void spherical_harmonics_kernels(KernelTables& tables);

}  // namespace semfield
