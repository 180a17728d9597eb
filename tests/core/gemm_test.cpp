// The matrix product against Eigen, its bitwise promises, and what it must not touch.
#include "compute/gemm.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <algorithm>
#include <cstring>
#include <limits>
#include <vector>

#include "core/rng.h"

namespace semfield {
namespace {

template <class Real>
std::vector<Real> random_values(std::size_t count, std::uint64_t seed) {
  std::vector<Real> values(count);
  for (std::size_t i = 0; i < count; ++i) values[i] = static_cast<Real>(2 * uniform01({seed, 0, 1}, i) - 1);
  return values;
}

template <class Real>
using Matrix = Eigen::Matrix<Real, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
template <class Real>
using Mapped = Eigen::Map<const Matrix<Real>, 0, Eigen::OuterStride<>>;

template <class Real>
Mapped<Real> mapped(const Real* data, std::int64_t rows, std::int64_t cols, std::int64_t stride) {
  return Mapped<Real>(data, rows, cols, Eigen::OuterStride<>(stride));
}

enum class Start { zero, accumulate, bias, row_term };

struct Shape {
  std::int64_t m, n, k;
};

const Shape kShapes[] = {{1, 1, 1},    {2, 3, 5},    {5, 16, 7},   {6, 64, 64},  {13, 65, 31}, {31, 13, 63},
                         {33, 80, 17}, {37, 48, 9},  {64, 33, 16}, {100, 1, 70}, {7, 130, 3},  {12, 128, 1},
                         {25, 8, 600}, {9, 70, 513}, {3, 4, 0},    {0, 5, 5},    {5, 0, 5},    {48, 96, 256}};

template <class Real>
class GemmTest : public ::testing::Test {};
using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(GemmTest, Reals);

TYPED_TEST(GemmTest, MatchesEigenForEveryStrideStartAndTail) {
  using Real = TypeParam;
  constexpr Real kGuard = 12345;
  int cases = 0;
  for (const Shape& s : kShapes) {
    for (int layout = 0; layout < 3; ++layout) {  // rows of A contiguous, columns contiguous, neither
      for (const Start start : {Start::zero, Start::accumulate, Start::bias, Start::row_term}) {
        const std::int64_t a_row = layout == 0 ? s.k + 3 : layout == 1 ? 1 : 2 * s.k + 5;
        const std::int64_t a_col = layout == 0 ? 1 : layout == 1 ? s.m + 2 : 2;
        const std::int64_t b_row = s.n + 1, c_row = s.n + 2;
        const auto a = random_values<Real>(static_cast<std::size_t>(s.m * a_row + s.k * a_col + 1), 1);
        const auto b = random_values<Real>(static_cast<std::size_t>(s.k * b_row + 1), 2);
        const auto extra = random_values<Real>(static_cast<std::size_t>(4 * s.n + 1), 3);
        std::vector<Real> c(static_cast<std::size_t>(s.m * c_row + 1), kGuard);
        std::vector<std::int32_t> row_of(static_cast<std::size_t>(s.m));
        for (std::size_t i = 0; i < row_of.size(); ++i)
          row_of[i] = static_cast<std::int32_t>(i * 4 / (row_of.size() + 1));
        Matrix<Real> expected = Matrix<Real>::Zero(s.m, s.n);
        for (std::int64_t i = 0; i < s.m; ++i) {
          for (std::int64_t j = 0; j < s.n; ++j) {
            const auto at = static_cast<std::size_t>(i * c_row + j);
            c[at] = static_cast<Real>(0.01) * static_cast<Real>(i - j);
            const std::int64_t ray = row_of[i];
            if (start == Start::accumulate) expected(i, j) = c[at];
            if (start == Start::bias) expected(i, j) = extra[j];
            if (start == Start::row_term) expected(i, j) = extra[ray * s.n + j];
          }
        }
        Matrix<Real> a_dense(s.m, s.k);
        for (std::int64_t i = 0; i < s.m; ++i) {
          for (std::int64_t k = 0; k < s.k; ++k) a_dense(i, k) = a[i * a_row + k * a_col];
        }
        if (s.k > 0) expected += a_dense * mapped(b.data(), s.k, s.n, b_row);
        const bool relu = start == Start::bias;
        if (relu) expected = expected.cwiseMax(Real(0));
        Gemm<Real> g{.m = s.m,
                     .n = s.n,
                     .k = s.k,
                     .a = a.data(),
                     .a_row = a_row,
                     .a_col = a_col,
                     .b = b.data(),
                     .b_row = b_row,
                     .c = c.data(),
                     .c_row = c_row,
                     .relu = relu};
        g.accumulate = start == Start::accumulate;
        if (start == Start::bias) g.bias = extra.data();
        if (start == Start::row_term) {
          g.row_term = extra.data();
          g.row_term_stride = s.n;
          g.row_of = row_of.data();
        }
        gemm(g);
        const double tolerance = 4 * std::numeric_limits<Real>::epsilon() * (1 + static_cast<double>(s.k));
        for (std::int64_t i = 0; i < s.m; ++i) {
          for (std::int64_t j = 0; j < s.n; ++j)
            ASSERT_NEAR(c[i * c_row + j], expected(i, j), tolerance)
                << "m " << s.m << " n " << s.n << " k " << s.k << " layout " << layout << " at " << i << ", " << j;
          for (std::int64_t j = s.n; j < c_row; ++j) ASSERT_EQ(c[i * c_row + j], kGuard);
        }
        ASSERT_EQ(c.back(), kGuard);
        ++cases;
      }
    }
  }
  EXPECT_EQ(cases, 18 * 3 * 4);
}

TYPED_TEST(GemmTest, SplittingRowsOrDepthGivesTheSameBits) {
  using Real = TypeParam;
  for (const std::int64_t n : {1, 3, 13, 16, 64, 100}) {
    const std::int64_t m = 53, k = 300;
    const auto a = random_values<Real>(static_cast<std::size_t>(m * k), 4);
    const auto b = random_values<Real>(static_cast<std::size_t>(k * n), 5);
    std::vector<Real> whole(static_cast<std::size_t>(m * n)), split(whole.size()), deep(whole.size());
    Gemm<Real> g{
        .m = m, .n = n, .k = k, .a = a.data(), .a_row = k, .b = b.data(), .b_row = n, .c = whole.data(), .c_row = n};
    gemm(g);
    // Every tile height and both ways of reading B (packed or in place) take part.
    for (std::int64_t row = 0, size = 1; row < m; row += size++) {
      g.m = std::min(size, m - row);
      g.a = a.data() + row * k;
      g.c = split.data() + row * n;
      gemm(g);
    }
    EXPECT_EQ(std::memcmp(whole.data(), split.data(), whole.size() * sizeof(Real)), 0) << "n " << n;
    for (std::int64_t first = 0; first < k; first += 77) {
      gemm(Gemm<Real>{.m = m,
                      .n = n,
                      .k = std::min<std::int64_t>(77, k - first),
                      .a = a.data() + first,
                      .a_row = k,
                      .b = b.data() + first * n,
                      .b_row = n,
                      .c = deep.data(),
                      .c_row = n,
                      .accumulate = first > 0});
    }
    EXPECT_EQ(std::memcmp(whole.data(), deep.data(), whole.size() * sizeof(Real)), 0) << "n " << n;
  }
}

TYPED_TEST(GemmTest, WeightGradientEqualsTheGeneralProductInBits) {
  using Real = TypeParam;
  for (const std::int32_t n : {1, 3, 8, 9, 16, 70}) {
    for (const std::int32_t m : {5, 16, 64, 130}) {
      const std::int64_t rows = 270;
      auto x = random_values<Real>(static_cast<std::size_t>(rows * m), 6);
      auto dy = random_values<Real>(static_cast<std::size_t>(rows * n), 7);
      auto c = random_values<Real>(static_cast<std::size_t>(m * n), 8);
      auto d = c;
      gemm_at_b_add(View<const Real>(x.data(), rows, m), View<const Real>(dy.data(), rows, n),
                    View<Real>(c.data(), m, n));
      for (std::int32_t i = 0; i < m; ++i) {
        for (std::int32_t j = 0; j < n; ++j) {
          Real& sum = d[i * n + j];
          for (std::int64_t r = 0; r < rows; ++r) sum = std::fma(x[r * m + i], dy[r * n + j], sum);
        }
      }
#if defined(__FMA__)
      EXPECT_EQ(std::memcmp(c.data(), d.data(), c.size() * sizeof(Real)), 0) << "m " << m << " n " << n;
#else
      for (std::size_t i = 0; i < c.size(); ++i) EXPECT_NEAR(c[i], d[i], 600 * std::numeric_limits<Real>::epsilon());
#endif
    }
  }
}

TYPED_TEST(GemmTest, RefusesTwoStartsAndShapesThatDoNotFit) {
  using Real = TypeParam;
  Real x[6] = {};
  EXPECT_THROW(gemm(Gemm<Real>{.m = 1,
                               .n = 1,
                               .k = 1,
                               .a = x,
                               .a_row = 1,
                               .b = x,
                               .b_row = 1,
                               .c = x + 1,
                               .c_row = 1,
                               .accumulate = true,
                               .bias = x}),
               std::exception);
  EXPECT_THROW(gemm(View<const Real>(x, 2, 3), View<const Real>(x, 2, 3), View<Real>(x, 2, 3)), std::exception);
}

}  // namespace
}  // namespace semfield
