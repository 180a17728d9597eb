#include "compute/gemm.h"

#include <algorithm>
#include <type_traits>

#include "compute/cpu_kernels.h"
#include "compute/gemm_engine.h"
#include "core/check.h"

namespace semfield {

namespace {
thread_local std::int64_t multiply_adds_so_far = 0;
}

std::int64_t multiply_adds_of_thread() noexcept { return multiply_adds_so_far; }

template <class Real>
void gemm(const Gemm<Real>& g) {
  SEMFIELD_CHECK(int{g.accumulate} + int{g.bias != nullptr} + int{g.row_term != nullptr} <= 1,
                 "a matrix product starts from one of: its old value, a bias, a row term");
  if constexpr (std::is_same_v<Real, float>) {
    // Narrow products gain nothing from bf16: converting their operands costs what the sums save.
    constexpr std::int64_t kNarrow = 8;
    if (g.precision == Precision::bf16 && (g.n <= kNarrow || g.k <= kNarrow)) {
      Gemm<float> exact = g;
      exact.precision = Precision::fp32;
      return gemm(exact);
    }
  }
  multiply_adds_so_far += g.m * g.n * g.k;
  if constexpr (std::is_same_v<Real, float>) {
    if (const OnednnGemm* foreign = foreign_gemm(); foreign != nullptr && foreign->run(g)) return;
    if (g.precision == Precision::bf16) return bf16_gemm()(g);
  }
  cpu_kernels<Real>().gemm(g);
}

template <class Real>
void gemm(View<const Real> a, View<const Real> b, View<Real> c, bool accumulate, Precision precision,
          View<const Real> mask) {
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
                  .mask_row = mask.row_stride,
                  .precision = precision});
}

template <class Real>
void gemm_at_b_add(View<const Real> a, View<const Real> b, View<Real> c, Precision precision) {
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
                    .accumulate = true,
                    .precision = precision});
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
                    .accumulate = true,
                    .precision = precision});
    for (std::int32_t i = 0; i < count; ++i) {
      for (std::int32_t j = 0; j < b.cols; ++j) c(first + i, j) = strip[j * kStrip + i];
    }
  }
}

template void gemm<float>(const Gemm<float>&);
template void gemm<double>(const Gemm<double>&);
template void gemm<float>(View<const float>, View<const float>, View<float>, bool, Precision, View<const float>);
template void gemm<double>(View<const double>, View<const double>, View<double>, bool, Precision, View<const double>);
template void gemm_at_b_add<float>(View<const float>, View<const float>, View<float>, Precision);
template void gemm_at_b_add<double>(View<const double>, View<const double>, View<double>, Precision);

}  // namespace semfield
