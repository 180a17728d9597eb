// Adam [Kingma15]: every element, or only the rows that received a gradient.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "compute/parallel.h"
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

// The loops over one range of a tensor, compiled once per instruction set (compute/isa.h).

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
  /// The limits of first_unsound for the rows that `touched` would visit, and some beside them.
  bool (*touched_sound)(const AdamRange<Real>& range);
};

// Several tensors cut into ranges that are the units of one parallel loop: a loop for each tensor would end with a
// wait.

/// Of value, gradient and moments together 256 KB in float, some ten microseconds of work.
inline constexpr std::int64_t kRangeElements = std::int64_t{1} << 14;

/// Rows of a range; from the shape alone.
inline std::int64_t rows_per_range(std::int32_t cols) {
  return std::max<std::int64_t>(1, kRangeElements / std::max<std::int32_t>(1, cols));
}

/// body(i, first row, rows) for the ranges of tensors 0 to tensors - 1, of which tensor i has rows(i) rows (0: none of
/// it) of cols(i) numbers.
template <class Rows, class Cols, class Body>
void for_ranges(int tensors, const Rows& rows, const Cols& cols, const Body& body) {
  const auto ranges = [&](int i) { return (rows(i) + rows_per_range(cols(i)) - 1) / rows_per_range(cols(i)); };
  std::int64_t units = 0;
  for (int i = 0; i < tensors; ++i) units += ranges(i);
  parallel_for(units, [&](std::int64_t unit) {
    int i = 0;
    for (; unit >= ranges(i); ++i) unit -= ranges(i);
    const std::int64_t range = rows_per_range(cols(i)), begin = unit * range;
    body(i, begin, std::min(range, rows(i) - begin));
  });
}

// Learning rate over the steps of a run, which may have several legs.

enum class ScheduleKind : std::uint8_t { constant, exponential, cosine };

SEMFIELD_CHOICES(ScheduleKind, "constant", "exponential", "cosine");

/// What a run trains beyond the length that it began with, or after its length was settled anew.
struct ScheduleLeg {
  std::int64_t start = 0;
  double rate = 1;
  std::int64_t hold_until = 0;
  std::int64_t end = 0;
  double until_s = 0;
  bool operator==(const ScheduleLeg&) const = default;
};
void describe(ParamVisitor& visit, ScheduleLeg& leg);

struct ScheduleParams {
  ScheduleKind kind = ScheduleKind::exponential;
  double factor = 0.1;
  std::int64_t decay_steps = 250000;
  std::int64_t hold_steps = 0;
  std::int64_t warmup_steps = 0;
  std::vector<ScheduleLeg> legs;  ///< by ascending start; no parameter of describe()
};
void describe(ParamVisitor& visit, ScheduleParams& params);

/// Multiplier of the learning rate at `step` (0-based). With p = (step - hold_steps) / (decay_steps - hold_steps),
/// which is 0 before and 1 behind:
///   constant     1
///   exponential  factor^p
///   cosine       factor + (1 - factor) (1 + cos(pi p)) / 2
/// times (step + 1) / warmup_steps while step < warmup_steps. From the start of a leg on, the leg's own hold_until and
/// end are meant, and its rate in place of 1. Without an end (0: not settled yet) the rate is held.
double schedule_factor(const ScheduleParams& params, std::int64_t step);

/// First step, 0-based, of what begins after `share` of a run of `steps` steps: never while the rate is held before its
/// first fall, because until then nobody may know `steps` (0), and what waits for a share of them waits.
std::int64_t step_of_share(double share, std::int64_t steps, const ScheduleParams& params);

}  // namespace semfield
