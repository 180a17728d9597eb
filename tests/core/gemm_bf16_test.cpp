// The bf16 matrix product: its error bound against float64, exactness where no rounding happens, bitwise promises,
// guards.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "compute/gemm.h"
#include "core/rng.h"

namespace semfield {
namespace {

constexpr float kGuard = 12345;

struct Shape {
  std::int64_t m, n, k;
};
const Shape kShapes[] = {{1, 1, 1},    {2, 3, 5},    {5, 16, 7},    {6, 64, 64},  {13, 65, 31}, {31, 13, 63},
                         {33, 80, 17}, {37, 48, 9},  {64, 33, 16},  {100, 1, 70}, {7, 130, 3},  {12, 128, 1},
                         {25, 8, 600}, {9, 70, 513}, {3, 4, 0},     {0, 5, 5},    {5, 0, 5},    {48, 96, 256},
                         {49, 257, 6}, {97, 300, 2}, {50, 64, 1025}};

/// A product with its operands laid out as `layout` says: 0 rows of A contiguous, 1 its columns, 2 neither.
struct Case {
  Case(const Shape& s, int layout_in, bool integers) : shape(s), layout(layout_in) {
    g.m = s.m;
    g.n = s.n;
    g.k = s.k;
    g.a_row = layout == 0 ? s.k + 3 : layout == 1 ? 1 : 2 * s.k + 5;
    g.a_col = layout == 0 ? 1 : layout == 1 ? s.m + 2 : 2;
    g.b_row = s.n + 1;
    g.c_row = s.n + 2;
    g.precision = Precision::bf16;
    const auto fill = [&](std::vector<float>& values, std::int64_t count, std::uint64_t seed) {
      values.resize(static_cast<std::size_t>(count));
      for (std::size_t i = 0; i < values.size(); ++i) {
        const double u = 2 * uniform01({seed, 0, 1}, i) - 1;
        values[i] = static_cast<float>(integers ? std::round(15 * u) : u);
      }
    };
    fill(a, s.m * g.a_row + s.k * g.a_col + 1, 1);
    fill(b, s.k * g.b_row + 1, 2);
    fill(bias, s.n, 3);
    c.assign(static_cast<std::size_t>(s.m * g.c_row + 1), kGuard);
    g.a = a.data();
    g.b = b.data();
    g.c = c.data();
    g.bias = bias.data();
  }
  double exact(std::int64_t i, std::int64_t j, double& magnitude) const {
    double sum = bias[static_cast<std::size_t>(j)];
    magnitude = 0;
    for (std::int64_t k = 0; k < shape.k; ++k) {
      const double product = static_cast<double>(g.a[i * g.a_row + k * g.a_col]) * g.b[k * g.b_row + j];
      sum += product;
      magnitude += std::fabs(product);
    }
    return sum;
  }

  Shape shape;
  int layout;
  std::vector<float> a, b, bias, c;
  Gemm<float> g;
};

TEST(GemmBf16, StaysWithinItsErrorBoundForEveryStrideAndTail) {
  for (const Shape& s : kShapes) {
    for (int layout = 0; layout < 3; ++layout) {
      Case test(s, layout, false);
      gemm(test.g);
      for (std::int64_t i = 0; i < s.m; ++i) {
        for (std::int64_t j = 0; j < s.n; ++j) {
          double magnitude = 0;
          const double exact = test.exact(i, j, magnitude);
          // 8 significant bits: each operand is off by at most 2^-8 of itself, a product so by 2^-7 + 2^-16; sums are
          // fp32.
          const double bound = (std::ldexp(1.0, -7) + std::ldexp(1.0, -16)) * magnitude +
                               static_cast<double>(s.k + 1) * std::ldexp(1.0, -23) * (magnitude + 1);
          ASSERT_NEAR(test.c[static_cast<std::size_t>(i * test.g.c_row + j)], exact, bound)
              << "m " << s.m << " n " << s.n << " k " << s.k << " layout " << layout << " at " << i << ", " << j;
        }
        for (std::int64_t j = s.n; j < test.g.c_row; ++j)
          ASSERT_EQ(test.c[static_cast<std::size_t>(i * test.g.c_row + j)], kGuard);
      }
      ASSERT_EQ(test.c.back(), kGuard);
    }
  }
}

TEST(GemmBf16, IsExactWhereNothingNeedsRounding) {
  for (const Shape& s : kShapes) {
    for (int layout = 0; layout < 3; ++layout) {
      Case test(s, layout, true);  // integers up to 15 are bf16 numbers, their sums are fp32 numbers
      gemm(test.g);
      for (std::int64_t i = 0; i < s.m; ++i) {
        for (std::int64_t j = 0; j < s.n; ++j) {
          double magnitude = 0;
          ASSERT_EQ(test.c[static_cast<std::size_t>(i * test.g.c_row + j)], test.exact(i, j, magnitude))
              << "m " << s.m << " n " << s.n << " k " << s.k << " layout " << layout << " at " << i << ", " << j;
        }
      }
    }
  }
}

TEST(GemmBf16, MaskZeroesWhereItIsNotPositive) {
  for (const Shape& s : kShapes) {
    for (const Precision precision : {Precision::fp32, Precision::bf16}) {
      Case plain(s, 0, true), masked(s, 0, true);
      std::vector<float> mask(static_cast<std::size_t>(s.m * (s.n + 5) + 1));
      for (std::size_t i = 0; i < mask.size(); ++i) mask[i] = static_cast<float>(i * 7 % 5) - 2;  // -2 .. 2
      plain.g.precision = masked.g.precision = precision;
      masked.g.mask = mask.data();
      masked.g.mask_row = s.n + 5;
      gemm(plain.g);
      gemm(masked.g);
      for (std::int64_t i = 0; i < s.m; ++i) {
        for (std::int64_t j = 0; j < s.n; ++j) {
          const auto at = static_cast<std::size_t>(i * plain.g.c_row + j);
          const bool keep = mask[static_cast<std::size_t>(i * (s.n + 5) + j)] > 0;
          ASSERT_EQ(masked.c[at], keep ? plain.c[at] : 0.0f) << "m " << s.m << " n " << s.n << " k " << s.k;
        }
        for (std::int64_t j = s.n; j < plain.g.c_row; ++j)
          ASSERT_EQ(masked.c[static_cast<std::size_t>(i * plain.g.c_row + j)], kGuard);
      }
    }
  }
}

// value * 1 as one element of a product wide enough for bf16; either operand takes the value.
float once_times_one(float value, bool as_a) {
  constexpr int kSize = 16;
  std::vector<float> a(kSize * kSize), b(kSize * kSize), c(kSize * kSize);
  (as_a ? a : b)[0] = value;
  (as_a ? b : a)[0] = 1;
  gemm(Gemm<float>{.m = kSize,
                   .n = kSize,
                   .k = kSize,
                   .a = a.data(),
                   .a_row = kSize,
                   .b = b.data(),
                   .b_row = kSize,
                   .c = c.data(),
                   .c_row = kSize,
                   .precision = Precision::bf16});
  return c[0];
}

TEST(GemmBf16, RoundsToNearestEven) {
  // 1 + 2^-8 lies between the bf16 numbers 1 and 1 + 2^-7, as far from both: to the even one, 1. A little above: 1 +
  // 2^-7.
  for (const auto& [value, expected] : {std::pair<float, float>{1.00390625f, 1.0f},
                                        {1.0039064f, 1.0078125f},
                                        {1.01171875f, 1.015625f},
                                        {-1.00390625f, -1.0f}}) {
    EXPECT_EQ(once_times_one(value, true), expected);
    EXPECT_EQ(once_times_one(value, false), expected);
  }
}

TEST(GemmBf16, LeavesNarrowProductsToFp32) {
  for (const Shape& s : {Shape{20, 8, 40}, Shape{20, 40, 8}}) {
    Case narrow(s, 0, false), exact(s, 0, false);
    exact.g.precision = Precision::fp32;
    gemm(narrow.g);
    gemm(exact.g);
    EXPECT_EQ(std::memcmp(narrow.c.data(), exact.c.data(), exact.c.size() * sizeof(float)), 0);
  }
}

TEST(GemmBf16, SplittingRowsOrDepthAtMultiplesOf32GivesTheSameBits) {
  for (const std::int64_t n : {1, 3, 13, 16, 64, 100}) {
    Case whole({101, n, 300}, 0, false), split({101, n, 300}, 0, false), deep({101, n, 300}, 0, false);
    gemm(whole.g);
    for (std::int64_t row = 0, size = 1; row < 101; row += size++) {
      Gemm<float> part = split.g;
      part.m = std::min(size, 101 - row);
      part.a += row * part.a_row;
      part.c += row * part.c_row;
      gemm(part);
    }
    for (std::int64_t first = 0; first < 300; first += 96) {
      Gemm<float> part = deep.g;
      part.k = std::min<std::int64_t>(96, 300 - first);
      part.a += first;
      part.b += first * part.b_row;
      part.accumulate = first > 0;
      if (first > 0) part.bias = nullptr;
      gemm(part);
    }
    EXPECT_EQ(std::memcmp(whole.c.data(), split.c.data(), whole.c.size() * sizeof(float)), 0) << "n " << n;
    EXPECT_EQ(std::memcmp(whole.c.data(), deep.c.data(), whole.c.size() * sizeof(float)), 0) << "n " << n;
  }
}

TEST(GemmBf16, KeepsNotANumberAndInfinity) {
  const float inf = std::numeric_limits<float>::infinity();
  EXPECT_TRUE(std::isnan(once_times_one(std::numeric_limits<float>::quiet_NaN(), true)));
  for (const float value : {inf, -inf}) {
    // inf * 1 beside inf * 0 is no number; alone it stays.
    std::vector<float> a(16, 0), b(16 * 16, 1), c(16);
    a[0] = value;
    gemm(Gemm<float>{.m = 1,
                     .n = 16,
                     .k = 16,
                     .a = a.data(),
                     .a_row = 16,
                     .b = b.data(),
                     .b_row = 16,
                     .c = c.data(),
                     .c_row = 16,
                     .precision = Precision::bf16});
    for (const float got : c) EXPECT_EQ(got, value);
  }
}

}  // namespace
}  // namespace semfield
