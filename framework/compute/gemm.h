// Matrix product: the one place where multiply-adds of networks happen.
#pragma once

#include <cstdint>

#include "core/view.h"

namespace semfield {

/// C = start + A B, then the epilogue. Shapes: A [m, k] with any strides, so that the same kernel serves forward (X W),
/// input gradient (dY W^T, B a stored transpose) and weight gradient (X^T dY: a_row = 1, a_col = row stride of X); B
/// [k, n] and C [m, n] with contiguous columns. Strides in elements.
///
/// start, at most one of: accumulate (C's old value), bias (one row for all), row_term (row row_of[i], or row i when
/// row_of is null); none: zero. Each element of C is one chain of fused multiply-adds over k ascending from its start,
/// whatever m is and wherever its row stands: splitting the rows into calls, or k into accumulating calls, gives the
/// same bits.
template <class Real>
struct Gemm {
  std::int64_t m = 0, n = 0, k = 0;
  const Real* a = nullptr;
  std::int64_t a_row = 0, a_col = 1;
  const Real* b = nullptr;
  std::int64_t b_row = 0;
  Real* c = nullptr;
  std::int64_t c_row = 0;
  bool accumulate = false;
  const Real* bias = nullptr;      ///< [n]
  const Real* row_term = nullptr;  ///< [any, n], row stride row_term_stride
  std::int64_t row_term_stride = 0;
  const std::int32_t* row_of = nullptr;  ///< [m]
  std::int64_t row_of_stride = 1;
  bool relu = false;           ///< C = max(C, 0) at the end; NaN stays NaN
  const Real* mask = nullptr;  ///< [m, n], row stride mask_row: C = mask > 0 ? C : 0 at the end, the gradient of a ReLU
  std::int64_t mask_row = 0;
};

/// Runs in the calling thread; allocates nothing.
template <class Real>
void gemm(const Gemm<Real>& g);

/// The usual starts, from views: A B, or C + A B with `accumulate`; mask [m, n] as in Gemm (empty: none).
template <class Real>
void gemm(View<const Real> a, View<const Real> b, View<Real> c, bool accumulate = false, View<const Real> mask = {});

/// C += A^T B: weight gradients. A [rows, m], B [rows, n], C [m, n].
template <class Real>
void gemm_at_b_add(View<const Real> a, View<const Real> b, View<Real> c);

}  // namespace semfield
