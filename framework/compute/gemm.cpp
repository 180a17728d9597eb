#include "compute/gemm.h"

#include <algorithm>

#include "compute/isa.h"
#include "core/check.h"

namespace semfield {

template <class Real>
void gemm(const Gemm<Real>& g) {
  SEMFIELD_CHECK(int{g.accumulate} + int{g.bias != nullptr} + int{g.row_term != nullptr} <= 1,
                 "a matrix product starts from one of: its old value, a bias, a row term");
  cpu_kernels<Real>().gemm(g);
}

template <class Real>
void gemm(View<const Real> a, View<const Real> b, View<Real> c, bool accumulate, View<const Real> mask) {
  SEMFIELD_CHECK(a.cols == b.rows && a.rows == c.rows && b.cols == c.cols, "shapes of a matrix product do not fit");
  SEMFIELD_CHECK(mask.empty() || (mask.rows == c.rows && mask.cols == c.cols), "mask of a matrix product does not fit");
  gemm(Gemm<Real>{.m = a.rows,
                  .n = b.cols,
                  .k = a.cols,
                  .a = a.data,
                  .a_row = a.row_stride,
                  .b = b.data,
                  .b_row = b.row_stride,
                  .c = c.data,
                  .c_row = c.row_stride,
                  .accumulate = accumulate,
                  .mask = mask.data,
                  .mask_row = mask.row_stride});
}

template <class Real>
void gemm_at_b_add(View<const Real> a, View<const Real> b, View<Real> c) {
  SEMFIELD_CHECK(a.rows == b.rows && a.cols == c.rows && b.cols == c.cols, "shapes of a matrix product do not fit");
  constexpr int kNarrow = 8;
  if (b.cols > kNarrow || a.cols < 2 * kNarrow) {
    gemm(Gemm<Real>{.m = a.cols,
                    .n = b.cols,
                    .k = a.rows,
                    .a = a.data,
                    .a_row = 1,
                    .a_col = a.row_stride,
                    .b = b.data,
                    .b_row = b.row_stride,
                    .c = c.data,
                    .c_row = c.row_stride,
                    .accumulate = true});
    return;
  }
  // Few columns: C^T += B^T A fills whole vectors along A's columns. The same chain of products, so the same bits.
  constexpr std::int32_t kStrip = 64;
  Real strip[kNarrow * kStrip];
  for (std::int32_t first = 0; first < a.cols; first += kStrip) {
    const std::int32_t count = std::min(kStrip, a.cols - first);
    for (std::int32_t i = 0; i < count; ++i) {
      for (std::int32_t j = 0; j < b.cols; ++j) strip[j * kStrip + i] = c(first + i, j);
    }
    gemm(Gemm<Real>{.m = b.cols,
                    .n = count,
                    .k = a.rows,
                    .a = b.data,
                    .a_row = 1,
                    .a_col = b.row_stride,
                    .b = a.data + first,
                    .b_row = a.row_stride,
                    .c = strip,
                    .c_row = kStrip,
                    .accumulate = true});
    for (std::int32_t i = 0; i < count; ++i) {
      for (std::int32_t j = 0; j < b.cols; ++j) c(first + i, j) = strip[j * kStrip + i];
    }
  }
}

template void gemm<float>(const Gemm<float>&);
template void gemm<double>(const Gemm<double>&);
template void gemm<float>(View<const float>, View<const float>, View<float>, bool, View<const float>);
template void gemm<double>(View<const double>, View<const double>, View<double>, bool, View<const double>);
template void gemm_at_b_add<float>(View<const float>, View<const float>, View<float>);
template void gemm_at_b_add<double>(View<const double>, View<const double>, View<double>);

}  // namespace semfield
