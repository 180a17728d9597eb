// Arguments and kernel table of 'ripples', and its formulas for CPU and GPU.
#pragma once

#include <cmath>

#include "core/view.h"

namespace outside {

/// y[b] = cos((b + 1) s), s the sum of a row's coordinates; dx[d] = -sum_b dy[b] (b + 1) sin((b + 1) s).
template <class Real>
struct RipplesKernels {
  void (*forward)(semfield::View<const double> x, semfield::View<Real> y) = nullptr;
  void (*backward)(semfield::View<const double> x, semfield::View<const Real> dy, semfield::View<Real> dx) = nullptr;
  const char* variant = "";  ///< the instruction set that they were compiled for, or "cuda"
};

SEMFIELD_HD inline double ripples_phase(const double* row, std::int32_t cols) {
  double sum = 0;
  for (std::int32_t d = 0; d < cols; ++d) sum += row[d];
  return sum;
}

}  // namespace outside
