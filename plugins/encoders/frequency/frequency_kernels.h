// Arguments and kernel table of the frequency encoder.
#pragma once

#include "core/view.h"
#include "encoders/frequency/frequency_math.h"

namespace semfield {

class KernelTables;

struct FrequencyShape {
  std::int32_t dims = 3;
  std::int32_t frequencies = 10;
  bool include_input = true;
  Angular angular = Angular::radian;
  Arithmetic arithmetic = Arithmetic::float64;
};

/// Most coordinates of an input row.
inline constexpr std::int32_t kFrequencyMaxDims = 16;

template <class Real>
struct FrequencyKernels {
  /// Returns the first row that cannot be encoded (NaN or |x| > kFrequencyLimit), or -1. Runs in the calling thread.
  std::int64_t (*forward)(const FrequencyShape& shape, View<const double> x, View<Real> y) = nullptr;
  /// dx = dL/dx; parallel over blocks of rows.
  void (*backward)(const FrequencyShape& shape, View<const double> x, View<const Real> dy, View<Real> dx) = nullptr;
};

void frequency_kernels(KernelTables& tables);

}  // namespace semfield
