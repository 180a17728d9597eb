// Adam updates as plain vector loops, for one instruction set.
#include <cmath>
#include <type_traits>

#include "compute/isa.h"
#include "compute/math_functions.h"
#include "model/optim/adam.h"

namespace semfield::SEMFIELD_ISA {

void adam_kernels(AdamKernels<float>& kernels);
void adam_kernels(AdamKernels<double>& kernels);

namespace {

template <class Real>
struct Constants {
  Real beta1, one_minus_beta1, beta2, one_minus_beta2, step_size, root_scale, epsilon;
  explicit Constants(const AdamStep& s)
      : beta1(static_cast<Real>(s.beta1)),
        one_minus_beta1(static_cast<Real>(1 - s.beta1)),
        beta2(static_cast<Real>(s.beta2)),
        one_minus_beta2(static_cast<Real>(1 - s.beta2)),
        step_size(static_cast<Real>(s.step_size)),
        root_scale(static_cast<Real>(s.root_scale)),
        epsilon(static_cast<Real>(s.epsilon)) {}
};

template <class Real>
struct Moments {
  Real mean, square;
};

// [Kingma15, Alg. 1].
template <class Real>
inline Moments<Real> next_moments(const Constants<Real>& k, Real g, Real m, Real v) {
  return {multiply_add(k.beta1, m, k.one_minus_beta1 * g), multiply_add(k.beta2, v, k.one_minus_beta2 * (g * g))};
}
template <class Real>
inline Real next_value(const Constants<Real>& k, Real x, const Moments<Real>& at) {
  return x - k.step_size * at.mean / multiply_add(std::sqrt(at.square), k.root_scale, k.epsilon);
}

template <class Real>
inline void update(const Constants<Real>& k, Real* __restrict x, const Real* __restrict g, Real* __restrict m,
                   Real* __restrict v, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) {
    const Moments<Real> next = next_moments(k, g[i], m[i], v[i]);
    m[i] = next.mean;
    v[i] = next.square;
    x[i] = next_value(k, x[i], next);
  }
}

template <class Real>
bool any_non_zero(const Real* g, std::int64_t n) {
  int any = 0;
  for (std::int64_t i = 0; i < n; ++i) any |= g[i] != Real(0);
  return any != 0;
}

// A block is 16 elements: whole rows of 1, 2, 4 or 8 columns.
constexpr std::int64_t kBlockElements = 16;

// Lane i is all ones where the row of element i has a non-zero gradient.
template <class Int, int kCols>
inline void spread_to_rows(Int* __restrict hit) {
  for (int width = 1; width < kCols; width *= 2) {
    Int partner[kBlockElements];
    for (std::int64_t i = 0; i < kBlockElements; ++i) partner[i] = hit[i ^ width];
    for (std::int64_t i = 0; i < kBlockElements; ++i) hit[i] |= partner[i];
  }
}

// The rule for the touched rows of a block without a branch a row: untouched ones get their old bits back. Returns the
// touched elements.
template <class Real, int kCols>
inline std::int64_t update_block(const Constants<Real>& k, Real* __restrict x, Real* __restrict g, Real* __restrict m,
                                 Real* __restrict v) {
  using Int = std::conditional_t<sizeof(Real) == 4, std::int32_t, std::int64_t>;
  alignas(64) Int hit[kBlockElements];
  for (std::int64_t i = 0; i < kBlockElements; ++i) hit[i] = g[i] != Real(0) ? Int(-1) : Int(0);
  spread_to_rows<Int, kCols>(hit);
  Int elements = 0;
  for (std::int64_t i = 0; i < kBlockElements; ++i) elements -= hit[i];
  for (std::int64_t i = 0; i < kBlockElements; ++i) {
    const Moments<Real> next = next_moments(k, g[i], m[i], v[i]);
    const Real moved = next_value(k, x[i], next);
    m[i] = hit[i] != 0 ? next.mean : m[i];
    v[i] = hit[i] != 0 ? next.square : v[i];
    x[i] = hit[i] != 0 ? moved : x[i];
    g[i] = 0;
  }
  return elements;
}

// Rows [begin, rows) of any width, one after another.
template <class Real>
std::int64_t touched_rows(const Constants<Real>& constants, const AdamRange<Real>& range, std::int64_t begin) {
  std::int64_t touched = 0;
  for (std::int64_t at = begin * range.cols; at < range.rows * range.cols; at += range.cols) {
    if (!any_non_zero(range.grad + at, range.cols)) continue;
    update(constants, range.value + at, range.grad + at, range.m + at, range.v + at, range.cols);
    for (std::int32_t c = 0; c < range.cols; ++c) range.grad[at + c] = 0;
    ++touched;
  }
  return touched;
}

// Whole blocks of rows of kCols columns, then the rows that are left over.
template <class Real, int kCols>
std::int64_t touched_blocks(const Constants<Real>& constants, const AdamRange<Real>& range) {
  constexpr std::int64_t kRows = kBlockElements / kCols;
  const std::int64_t blocks = range.rows / kRows;
  std::int64_t elements = 0;
  for (std::int64_t at = 0; at < blocks * kBlockElements; at += kBlockElements) {
    if (!any_non_zero(range.grad + at, kBlockElements)) continue;
    elements += update_block<Real, kCols>(constants, range.value + at, range.grad + at, range.m + at, range.v + at);
  }
  return elements / kCols + touched_rows(constants, range, blocks * kRows);
}

template <class Real>
void dense(const AdamStep& step, const AdamRange<Real>& range) {
  update(Constants<Real>(step), range.value, range.grad, range.m, range.v, range.rows * range.cols);
}

template <class Real>
std::int64_t touched(const AdamStep& step, const AdamRange<Real>& range) {
  const Constants<Real> constants(step);
  switch (range.cols) {
    case 1:
      return touched_blocks<Real, 1>(constants, range);
    case 2:
      return touched_blocks<Real, 2>(constants, range);
    case 4:
      return touched_blocks<Real, 4>(constants, range);
    case 8:
      return touched_blocks<Real, 8>(constants, range);
    default:
      return touched_rows(constants, range, 0);
  }
}

template <class Real>
bool all_within(const Real* values, std::int64_t count, Real low, Real high) {
  int bad = 0;
  for (std::int64_t i = 0; i < count; ++i) bad |= !(values[i] >= low) | !(values[i] <= high);
  return bad == 0;
}

// Elements [at, at + n) of a block: untouched, or all sound. n is a constant for whole blocks, which then vectorise.
// The limits of the moments hold for NaN too: each comparison is written so that NaN fails it.
template <class Real>
inline int unsound_block(const AdamRange<Real>& range, std::int64_t at, std::int64_t n) {
  constexpr Real kLargest = kLargestSound<Real>, kLargestSquare = kLargest * kLargest;
  const Real* const g = range.grad + at;
  if (!any_non_zero(g, n)) return 0;
  const Real* const x = range.value + at;
  const Real* const m = range.m + at;
  const Real* const v = range.v + at;
  int bad = 0;
  for (std::int64_t i = 0; i < n; ++i) {
    // Integers, so that nothing branches.
    bad |= static_cast<int>(!(std::abs(g[i]) <= kLargest)) | static_cast<int>(!(std::abs(x[i]) <= kLargest)) |
           static_cast<int>(!(std::abs(m[i]) <= kLargest)) | static_cast<int>(!(v[i] >= 0)) |
           static_cast<int>(!(v[i] <= kLargestSquare));
  }
  return bad;
}

template <class Real>
bool touched_sound(const AdamRange<Real>& range) {
  const std::int64_t size = range.rows * range.cols, whole = size / kBlockElements * kBlockElements;
  int bad = 0;
  for (std::int64_t at = 0; at < whole; at += kBlockElements) bad |= unsound_block(range, at, kBlockElements);
  return (bad | unsound_block(range, whole, size - whole)) == 0;
}

template <class Real>
void fill(AdamKernels<Real>& kernels) {
  kernels = {dense<Real>, touched<Real>, all_within<Real>, touched_sound<Real>};
}

}  // namespace

void adam_kernels(AdamKernels<float>& kernels) { fill(kernels); }
void adam_kernels(AdamKernels<double>& kernels) { fill(kernels); }

}  // namespace semfield::SEMFIELD_ISA
