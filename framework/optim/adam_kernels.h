// The loops of Adam over one range of a tensor, compiled once per instruction set (core/isa.h).
#pragma once

#include <cstdint>

#include "optim/adam.h"

namespace semfield {

/// Contiguous arrays of rows * cols elements: value, gradient and the two moments.
template <class Real>
struct AdamRange {
  Real* value;
  Real* grad;
  Real* m;
  Real* v;
  std::int64_t rows;
  std::int32_t cols;
};

template <class Real>
struct AdamKernels {
  void (*dense)(const AdamStep& step, const AdamRange<Real>& range);  ///< the gradient is left as it is
  std::int64_t (*touched)(const AdamStep& step, const AdamRange<Real>& range);
  bool (*all_finite)(const Real* values, std::int64_t count);
};

}  // namespace semfield
