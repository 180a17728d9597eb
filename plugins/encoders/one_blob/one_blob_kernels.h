// Arguments and kernel table of the one-blob encoder.
#pragma once

#include "core/view.h"
#include "encoders/one_blob/one_blob_math.h"

namespace semfield {

class KernelTables;

/// Coordinates of an input row, and most bins of one.
inline constexpr std::int32_t kOneBlobDims = 3;
inline constexpr std::int32_t kOneBlobMaxBins = 64;

template <class Real>
struct OneBlobKernels {
  /// Returns the first row that is not finite, or -1. Runs in the calling thread.
  std::int64_t (*forward)(std::int32_t bins, View<const double> x, View<Real> y) = nullptr;
  /// dx = dL/dx; parallel over blocks of rows.
  void (*backward)(std::int32_t bins, View<const double> x, View<const Real> dy, View<Real> dx) = nullptr;
};

void one_blob_kernels(KernelTables& tables);

}  // namespace semfield
