#include "compute/row_loops.h"

#include <algorithm>

#include "compute/cpu_kernels.h"
#include "core/check.h"

namespace semfield {

template <class Real>
void relu_backward(View<const Real> y, View<Real> dy) {
  SEMFIELD_CHECK(y.rows == dy.rows && y.cols == dy.cols, "shapes of a ReLU do not fit");
  cpu_kernels<Real>().relu_backward(y, dy);
}

template <class Real>
void transpose(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.cols && in.cols == out.rows, "shapes of a transpose do not fit");
  constexpr std::int32_t kBlock = 16;  // a block's rows stay in cache while its columns are written
  for (std::int64_t r0 = 0; r0 < in.rows; r0 += kBlock) {
    const std::int64_t r1 = std::min<std::int64_t>(in.rows, r0 + kBlock);
    for (std::int32_t c = 0; c < in.cols; ++c) {
      for (std::int64_t r = r0; r < r1; ++r) out(c, static_cast<std::int32_t>(r)) = in(r, c);
    }
  }
}

template <class Real>
void copy_rows(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.rows && in.cols == out.cols, "shapes of a copy do not fit");
  for (std::int64_t r = 0; r < in.rows; ++r) std::copy_n(in.row(r), in.cols, out.row(r));
}

template <class Real>
void fill(View<Real> out, Real value) {
  for (std::int64_t r = 0; r < out.rows; ++r) std::fill_n(out.row(r), out.cols, value);
}

SEMFIELD_ROW_LOOPS_OF(, float)
SEMFIELD_ROW_LOOPS_OF(, double)

}  // namespace semfield
