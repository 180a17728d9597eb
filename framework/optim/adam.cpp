// Adam updates as plain vector loops over ranges of rows.
#include "optim/adam.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <type_traits>

#include "core/check.h"
#include "core/parallel.h"

namespace semfield {
namespace {

constexpr std::int64_t kRangeElements = std::int64_t{1} << 16;  // a parallel range: 1 MB of value, gradient and moments

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

// a b + c, fused wherever the machine can. Spelled out: left to contraction, which of two products is fused may differ
// from loop to loop, and then an element's bits would depend on the range that it fell into.
template <class Real>
inline Real multiply_add(Real a, Real b, Real c) {
#if defined(__FMA__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

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

template <class Real, class Grad>
void check_shapes(const View<Real>& value, const Grad& grad, const View<Real>& m, const View<Real>& v) {
  SEMFIELD_CHECK(value.contiguous() && grad.contiguous() && m.contiguous() && v.contiguous(),
                 "the optimiser needs contiguous tensors");
  SEMFIELD_CHECK(value.size() == grad.size() && value.size() == m.size() && value.size() == v.size(),
                 "value, gradient and moments differ in size");
}

// Rows a range, such that ranges depend on the shape alone.
template <class Real>
std::int64_t rows_per_range(const View<Real>& value) {
  return std::max<std::int64_t>(1, kRangeElements / std::max<std::int64_t>(1, value.cols));
}

}  // namespace

void describe(ParamVisitor& visit, AdamParams& params) {
  SEMFIELD_PARAM(visit, params, learning_rate, "Step size of the first update [Kingma15 alpha]", {0, 1});
  SEMFIELD_PARAM(visit, params, beta1, "Decay of the gradient's mean a step [Kingma15]", {0, 0.999999});
  SEMFIELD_PARAM(visit, params, beta2, "Decay of the squared gradient's mean a step [Kingma15]", {0, 0.99999999});
  SEMFIELD_PARAM(visit, params, epsilon, "Added to the root of the squared mean, against division by zero [Kingma15]",
                 {1e-30, 1});
}

AdamStep adam_step(const AdamParams& params, double learning_rate, std::int64_t step) {
  const double t = static_cast<double>(step) + 1;
  // 1 - beta^t; expm1 keeps its digits where beta^t is near 1, and log(0) = -inf gives 1.
  const double correction1 = -std::expm1(t * std::log(params.beta1));
  const double correction2 = -std::expm1(t * std::log(params.beta2));
  return {params.beta1, params.beta2, params.epsilon, learning_rate / correction1, 1.0 / std::sqrt(correction2)};
}

template <class Real>
void adam_dense(const AdamStep& step, View<Real> value, View<const Real> grad, View<Real> m, View<Real> v,
                std::int64_t begin, std::int64_t count) {
  const Constants<Real> constants(step);
  update(constants, value.row(begin), grad.row(begin), m.row(begin), v.row(begin), count * value.cols);
}

namespace {

// Rows of any width, one after another.
template <class Real>
std::int64_t touched_rows(const Constants<Real>& constants, View<Real> value, View<Real> grad, View<Real> m,
                          View<Real> v, std::int64_t begin, std::int64_t end) {
  std::int64_t touched = 0;
  for (std::int64_t r = begin; r < end; ++r) {
    Real* g = grad.row(r);
    if (!any_non_zero(g, value.cols)) continue;
    update(constants, value.row(r), g, m.row(r), v.row(r), value.cols);
    std::fill_n(g, value.cols, Real(0));
    ++touched;
  }
  return touched;
}

// Whole blocks of rows of kCols columns; returns the first row that is left over.
template <class Real, int kCols>
std::int64_t touched_blocks(const Constants<Real>& constants, View<Real> value, View<Real> grad, View<Real> m,
                            View<Real> v, std::int64_t begin, std::int64_t end, std::int64_t& touched) {
  constexpr std::int64_t kRows = kBlockElements / kCols;
  Real *x = value.row(begin), *g = grad.row(begin), *mean = m.row(begin), *square = v.row(begin);
  const std::int64_t blocks = (end - begin) / kRows;
  std::int64_t elements = 0;
  for (std::int64_t at = 0; at < blocks * kBlockElements; at += kBlockElements) {
    if (!any_non_zero(g + at, kBlockElements)) continue;
    elements += update_block<Real, kCols>(constants, x + at, g + at, mean + at, square + at);
  }
  touched += elements / kCols;
  return begin + blocks * kRows;
}

}  // namespace

template <class Real>
std::int64_t adam_touched(const AdamStep& step, View<Real> value, View<Real> grad, View<Real> m, View<Real> v,
                          std::int64_t begin, std::int64_t count) {
  const Constants<Real> constants(step);
  const std::int64_t end = begin + count;
  std::int64_t touched = 0, rest = begin;
  if (value.cols == 1) rest = touched_blocks<Real, 1>(constants, value, grad, m, v, begin, end, touched);
  if (value.cols == 2) rest = touched_blocks<Real, 2>(constants, value, grad, m, v, begin, end, touched);
  if (value.cols == 4) rest = touched_blocks<Real, 4>(constants, value, grad, m, v, begin, end, touched);
  if (value.cols == 8) rest = touched_blocks<Real, 8>(constants, value, grad, m, v, begin, end, touched);
  return touched + touched_rows(constants, value, grad, m, v, rest, end);
}

template <class Real>
void adam_dense_parallel(const AdamStep& step, View<Real> value, View<const Real> grad, View<Real> m, View<Real> v) {
  check_shapes(value, grad, m, v);
  struct Job {
    const AdamStep& step;
    View<Real> value;
    View<const Real> grad;
    View<Real> m, v;
    std::int64_t range;
  } const job{step, value, grad, m, v, rows_per_range(value)};
  parallel_for((value.rows + job.range - 1) / job.range, [&job](std::int64_t i) {
    const std::int64_t begin = i * job.range;
    adam_dense(job.step, job.value, job.grad, job.m, job.v, begin, std::min(job.range, job.value.rows - begin));
  });
}

template <class Real>
std::int64_t adam_touched_parallel(const AdamStep& step, View<Real> value, View<Real> grad, View<Real> m,
                                   View<Real> v) {
  check_shapes(value, grad, m, v);
  struct Job {
    const AdamStep& step;
    View<Real> value, grad, m, v;
    std::int64_t range;
    std::int64_t* touched;
  };
  std::int64_t touched = 0;
  const Job job{step, value, grad, m, v, rows_per_range(value), &touched};
  parallel_for((value.rows + job.range - 1) / job.range, [&job](std::int64_t i) {
    const std::int64_t begin = i * job.range;
    const std::int64_t rows = std::min(job.range, job.value.rows - begin);
    const std::int64_t n = adam_touched(job.step, job.value, job.grad, job.m, job.v, begin, rows);
    __atomic_fetch_add(job.touched, n, __ATOMIC_RELAXED);  // integers: any order gives the same sum
  });
  return touched;
}

template <class Real>
std::int64_t first_non_finite(View<const Real> values) {
  constexpr std::int64_t kBlock = 4096;
  constexpr Real kLargest = std::numeric_limits<Real>::max();
  SEMFIELD_CHECK(values.empty() || values.contiguous(), "the finite check needs contiguous tensors");
  const std::int64_t size = values.empty() ? 0 : values.size();
  for (std::int64_t begin = 0; begin < size; begin += kBlock) {
    const std::int64_t end = std::min(begin + kBlock, size);
    int bad = 0;
    for (std::int64_t i = begin; i < end; ++i) bad |= !(std::abs(values.data[i]) <= kLargest);
    if (bad == 0) continue;
    for (std::int64_t i = begin; i < end; ++i) {
      if (!(std::abs(values.data[i]) <= kLargest)) return i;
    }
  }
  return -1;
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                    \
  template void adam_dense<Real>(const AdamStep&, View<Real>, View<const Real>, View<Real>, View<Real>, std::int64_t, \
                                 std::int64_t);                                                                       \
  template std::int64_t adam_touched<Real>(const AdamStep&, View<Real>, View<Real>, View<Real>, View<Real>,           \
                                           std::int64_t, std::int64_t);                                               \
  template void adam_dense_parallel<Real>(const AdamStep&, View<Real>, View<const Real>, View<Real>, View<Real>);     \
  template std::int64_t adam_touched_parallel<Real>(const AdamStep&, View<Real>, View<Real>, View<Real>, View<Real>); \
  template std::int64_t first_non_finite<Real>(View<const Real>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
