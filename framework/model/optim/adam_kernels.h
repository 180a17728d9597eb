// The loops of Adam over one range of a tensor, compiled once per instruction set (compute/isa.h).
#pragma once

#include <cstdint>

#include "model/optim/adam.h"

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
  bool (*all_within)(const Real* values, std::int64_t count, Real low, Real high);  ///< false for a NaN
  /// The limits of first_unsound (model/optim/adam.h) for the rows that `touched` would visit, and some beside them.
  bool (*touched_sound)(const AdamRange<Real>& range);
};

}  // namespace semfield
