// Adam [Kingma15]: every element, or only the rows that received a gradient.
#pragma once

#include <cstdint>

#include "config/params.h"
#include "core/view.h"

namespace semfield {

struct AdamParams {
  double learning_rate = 5e-4;
  double beta1 = 0.9;
  double beta2 = 0.999;
  double epsilon = 1e-8;
};
void describe(ParamVisitor& visit, AdamParams& params);

/// The constants of one update, in double: shared by all tensors of a step.
struct AdamStep {
  double beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8;
  double step_size = 0;      ///< learning rate / (1 - beta1^t)
  double root_scale = 1;     ///< 1 / sqrt(1 - beta2^t)
  double learning_rate = 0;  ///< of the step, for weight decay
  double fade = 1;           ///< factor to the rate of tensors that fade
  bool labelled = true;      ///< false: no ray has a label, and semantic tensors stay as they are
  double decay = 0;          ///< of one tensor: share of a value that the step takes, before the update [Loshchilov19]
};

/// t = step + 1 counts updates from one; `step` is the number of updates already made. Any step up to 2^53.
AdamStep adam_step(const AdamParams& params, double learning_rate, std::int64_t step);

/// m = b1 m + (1 - b1) g, v = b2 v + (1 - b2) g^2, x = (1 - decay) x - step_size * m / (sqrt(v) * root_scale +
/// epsilon), for rows [begin, begin + count) of equal-shaped contiguous views. Elementwise: any split into ranges gives
/// the same bits. In float, v underflows to 0 for |g| below about 1e-21 (epsilon alone then scales the step) and
/// overflows above 1e19.
template <class Real>
void adam_dense(const AdamStep& step, View<Real> value, View<const Real> grad, View<Real> m, View<Real> v,
                std::int64_t begin, std::int64_t count);

/// The same for rows whose gradient has a non-zero element; other rows are not written at all. The gradient of a
/// touched row is zero afterwards, so that nobody has to clear the whole table. Lazy rule: the moments of an untouched
/// row do not decay, and bias correction uses the global step count. A NaN counts as non-zero. Returns the number of
/// rows touched.
template <class Real>
std::int64_t adam_touched(const AdamStep& step, View<Real> value, View<Real> grad, View<Real> m, View<Real> v,
                          std::int64_t begin, std::int64_t count);

/// Whole tensors, cut into fixed ranges over parallel_for.
template <class Real>
void adam_dense_parallel(const AdamStep& step, View<Real> value, View<const Real> grad, View<Real> m, View<Real> v);
template <class Real>
std::int64_t adam_touched_parallel(const AdamStep& step, View<Real> value, View<Real> grad, View<Real> m, View<Real> v);

/// A learned tensor as an update sees it: arrays of rows * cols numbers.
template <class Real>
struct AdamTensor {
  Real *value = nullptr, *grad = nullptr, *moment1 = nullptr, *moment2 = nullptr;
  std::int64_t rows = 0;
  std::int32_t cols = 0;
  bool touched_only = false;  ///< rows without a gradient are not written
  bool semantic = false;      ///< left alone in a step without labels
  double rate = 1;            ///< factor to the learning rate
  double decay = 0;           ///< a step takes (learning rate) * decay of each value; of dense tensors
  bool fades = false;         ///< AdamStep::fade is one more factor to the learning rate
};

/// All learned tensors of a run. The list and its arrays lie in the memory of the device that updates them.
template <class Real>
struct AdamTable {
  const AdamTensor<Real>* tensors = nullptr;
  int count = 0;
  std::int64_t elements = 0;  ///< of all tensors
};

/// One update of all tensors on the CPU. A step without a labelled ray says nothing about the semantic tensors:
/// they and their moments stay, as the rows of a table do that no ray touched. (Adam would move them along their old
/// moments.)
template <class Real>
void adam_update(const AdamStep* step, const AdamTable<Real>& table);

/// Index (row * cols + col) of the first NaN or infinity of a contiguous view, or -1. To be called for every gradient
/// before any update, so that a bad step leaves all state untouched.
template <class Real>
std::int64_t first_non_finite(View<const Real> values);

/// Largest magnitude of a value, a gradient or a first moment from which an update may start: their squares and the
/// update are then finite, so an update that begins with sound numbers ends with finite ones.
template <class Real>
inline constexpr Real kLargestSound = Real(1e150);
template <>
inline constexpr float kLargestSound<float> = 1e19F;

/// Steps in which the values and moments of a table's touched rows are looked at, a window of rows per step.
inline constexpr std::int64_t kTableWindows = 16;

/// An element from which no update may start.
template <class Real>
struct Unsound {
  const char* array = "";     ///< "value", "gradient", "first moment" or "second moment"
  std::int64_t element = -1;  ///< row * cols + col; -1: all are sound
  Real found = 0;
};

/// The first element of value, gradient or first moment that is NaN or larger than kLargestSound, or of the second
/// moment that is not in [0, kLargestSound^2]. To be called for every tensor before any update. `touched_only`: rows
/// without a gradient, which adam_touched does not visit, are not looked at either.
template <class Real>
Unsound<Real> first_unsound(View<const Real> value, View<const Real> grad, View<const Real> m, View<const Real> v,
                            bool touched_only);

}  // namespace semfield
