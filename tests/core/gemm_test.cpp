// The matrix product against Eigen, its bitwise promises, and what it must not touch.

#include "compute/gemm.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>
#include <string>
#include <vector>

#include "compute/bf16/tiles.h"
#include "compute/isa.h"
#include "compute/layers.h"
#include "compute/math_functions.h"
#include "core/rng.h"

namespace semfield {
namespace {

template <class Real>
std::vector<Real> random_values(std::int64_t count, std::uint64_t seed) {
  std::vector<Real> values(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<Real>(2 * uniform01({seed, 0, 1}, i) - 1);
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
        const auto a = random_values<Real>(s.m * a_row + s.k * a_col + 1, 1);
        const auto b = random_values<Real>(s.k * b_row + 1, 2);
        const auto extra = random_values<Real>(4 * s.n + 1, 3);
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
        Gemm<Real> g{.m = s.m, .n = s.n, .k = s.k, .a = a.data(), .a_row = a_row, .a_col = a_col};
        g.b = b.data(), g.b_row = b_row, g.c = c.data(), g.c_row = c_row, g.relu = relu;
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
    const auto a = random_values<Real>(m * k, 4);
    const auto b = random_values<Real>(k * n, 5);
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
      g.m = m, g.k = std::min<std::int64_t>(77, k - first);
      g.a = a.data() + first, g.b = b.data() + first * n, g.c = deep.data();
      g.accumulate = first > 0;
      gemm(g);
    }
    EXPECT_EQ(std::memcmp(whole.data(), deep.data(), whole.size() * sizeof(Real)), 0) << "n " << n;
  }
}

TYPED_TEST(GemmTest, WeightGradientEqualsTheGeneralProductInBits) {
  using Real = TypeParam;
  for (const std::int32_t n : {1, 3, 8, 9, 16, 70}) {
    for (const std::int32_t m : {5, 16, 64, 130}) {
      const std::int64_t rows = 270;
      auto x = random_values<Real>(rows * m, 6);
      auto dy = random_values<Real>(rows * n, 7);
      auto c = random_values<Real>(m * n, 8);
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
  Gemm<Real> two{.m = 1, .n = 1, .k = 1, .a = x, .a_row = 1, .b = x, .b_row = 1, .c = x + 1, .c_row = 1};
  two.accumulate = true;
  two.bias = x;
  EXPECT_THROW(gemm(two), std::exception);
  EXPECT_THROW(gemm(View<const Real>(x, 2, 3), View<const Real>(x, 2, 3), View<Real>(x, 2, 3)), std::exception);
}

// Layers: values by hand-written loops, gradients by central differences, ray terms, elementary functions.

struct Owned {
  Owned(std::int64_t rows, std::int32_t cols, std::uint64_t seed = 0) : values(static_cast<std::size_t>(rows * cols)) {
    view = View<double>(values.data(), rows, cols);
    if (seed == 0) return;
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = 2.0 * uniform01({seed, 0, 2}, i) - 1.0;
  }
  View<const double> read() const { return view; }
  std::vector<double> values;
  View<double> view;
};

double dot_all(View<const double> a, View<const double> b) {
  double sum = 0;
  for (std::int64_t r = 0; r < a.rows; ++r) {
    for (std::int32_t c = 0; c < a.cols; ++c) sum += a(r, c) * b(r, c);
  }
  return sum;
}

/// Largest difference between `gradient` and central differences of `loss` over the elements of `values`.
template <class Loss>
double worst_difference(std::vector<double>& values, View<const double> gradient, Loss loss) {
  double worst = 0;
  for (std::size_t i = 0; i < values.size(); ++i) {
    const double kept = values[i], step = 1e-6;
    values[i] = kept + step;
    const double up = loss();
    values[i] = kept - step;
    const double down = loss();
    values[i] = kept;
    worst = std::max(worst, std::abs((up - down) / (2 * step) - gradient.data[i]));
  }
  return worst;
}

/// y = x W + bias, and the ReLU.
Layer<double> layer_of(const Owned& x, const Owned& w, const Owned& bias, bool relu, const Owned& y) {
  return {.x = x.read(), .weight = w.read(), .start = bias.read(), .relu = relu, .y = y.view};
}

TEST(Layers, GradientsMatchCentralDifferences) {
  for (const bool relu : {false, true}) {
    Owned x(9, 6, 4), w(6, 5, 5), bias(1, 5, 6), y(9, 5), weight_t(5, 6), seed(9, 5, 7);
    const auto loss = [&] {
      apply(layer_of(x, w, bias, relu, y));
      return dot_all(y.read(), seed.read());
    };
    loss();
    transpose(w.read(), weight_t.view);
    Owned dz(9, 5), dx(9, 6), dw(6, 5), db(1, 5);
    dz.values = seed.values;
    if (relu) relu_backward(y.read(), dz.view);
    Layer<double> back{.x = dz.read(), .weight = weight_t.read(), .exact = dx.view};
    apply(back);
    weight_gradient(x.read(), dz.read(), dw.view, db.view);
    EXPECT_LT(worst_difference(x.values, dx.read(), loss), 1e-8);
    EXPECT_LT(worst_difference(w.values, dw.read(), loss), 1e-8);
    EXPECT_LT(worst_difference(bias.values, db.read(), loss), 1e-8);
    // Gradients of parameters add up; activations are assigned unless the layer starts from them.
    const auto once_w = dw.values, once_x = dx.values;
    back.start = dx.read();
    apply(back);
    weight_gradient(x.read(), dz.read(), dw.view, db.view);
    for (std::size_t i = 0; i < once_w.size(); ++i) EXPECT_NEAR(dw.values[i], 2 * once_w[i], 1e-12);
    for (std::size_t i = 0; i < once_x.size(); ++i) EXPECT_NEAR(dx.values[i], 2 * once_x[i], 1e-12);
  }
}

TEST(Layers, RayTermEqualsConcatenatedInputWithGradients) {
  const std::int64_t samples = 11, rays = 4;
  const std::vector<std::int32_t> ray_of{0, 0, 0, 1, 1, 3, 3, 3, 3, 3, 3};  // ray 2 has no sample
  const View<const std::int32_t> ray_view(ray_of.data(), samples, 1);
  Owned x(samples, 4, 8), w(4, 6, 9), term(rays, 6, 10), y(samples, 6), seed(samples, 6, 11);
  const auto loss = [&] {
    Layer<double> layer = layer_of(x, w, term, true, y);
    layer.row_of = ray_view;
    apply(layer);
    return dot_all(y.read(), seed.read());
  };
  loss();
  for (std::int64_t m = 0; m < samples; ++m) {
    for (int n = 0; n < 6; ++n) {
      double sum = term.view(ray_of[m], n);
      for (int k = 0; k < 4; ++k) sum += x.view(m, k) * w.view(k, n);
      EXPECT_NEAR(y.view(m, n), std::max(sum, 0.0), 1e-14);
    }
  }
  Owned dz(samples, 6), d_term(rays, 6);
  dz.values = seed.values;
  relu_backward(y.read(), dz.view);
  fill(d_term.view, std::numeric_limits<double>::quiet_NaN());
  per_ray_sum(dz.read(), ray_view, d_term.view);
  EXPECT_LT(worst_difference(term.values, d_term.read(), loss), 1e-8);
  for (int n = 0; n < 6; ++n) EXPECT_EQ(d_term.view(2, n), 0.0);
}

TEST(Layers, RefuseShapesThatDoNotFit) {
  const Owned x(2, 3), w(3, 2), wrong(4, 2), bias(1, 2), y(2, 2), few(3, 2);
  const Layer<double> good = layer_of(x, w, bias, false, y);
  EXPECT_NO_THROW(apply(good));
  const auto refused = [&](void (*spoil)(Layer<double>&, View<double>), const Owned& with) {
    Layer<double> layer = good;
    spoil(layer, with.view);
    EXPECT_THROW(apply(layer), std::exception);
  };
  refused([](Layer<double>& l, View<double> v) { l.weight = v; }, wrong);
  refused([](Layer<double>& l, View<double> v) { l.start = v; }, few);
  refused([](Layer<double>& l, View<double> v) { l.mask = v; }, few);
  refused([](Layer<double>& l, View<double> v) { l.exact = v; }, y);
  refused([](Layer<double>& l, View<double>) { l.y = {}; }, y);
  EXPECT_THROW(weight_gradient(x.read(), few.read(), w.view, bias.view), std::exception);
}

TEST(MathFunctions, AnElementDoesNotDependOnItsPlace) {
  std::vector<float> x(67);
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = 0.37f * static_cast<float>(i) - 9.0f;
  for (auto* function :
       {&exp_inplace<float>, &expm1_inplace<float>, &sigmoid_inplace<float>, &softplus_inplace<float>}) {
    auto whole = x;
    function(whole.data(), static_cast<std::int64_t>(whole.size()));
    for (std::size_t i = 0; i < x.size(); ++i) {
      float alone = x[i];
      function(&alone, 1);
      EXPECT_EQ(std::bit_cast<std::uint32_t>(alone), std::bit_cast<std::uint32_t>(whole[i])) << "element " << i;
    }
  }
}

// Case I01 of tests/numerics has the largest and what is not finite.
TEST(RowReductions, SumsAreThoseOfPlainLoopsForEveryLength) {
  for (std::int64_t n = 1; n < 70; ++n) {
    std::vector<float> x(static_cast<std::size_t>(n));
    double sum = 0;
    for (std::int64_t i = 0; i < n; ++i) {
      x[i] = static_cast<float>((i * 37 + 11) % 64) - 40;
      sum += static_cast<double>(x[i]);
    }
    EXPECT_EQ(sum_of(x.data(), n), sum);  // whole numbers: exact in any order
  }
  EXPECT_EQ(sum_of<float>(nullptr, 0), 0);
}

// Layers in bf16: their error bound against float64, exactness where nothing is rounded, bitwise promises, and what
// they must not touch.

namespace on_tiles = SEMFIELD_ISA::tiles;
using Plain = SEMFIELD_ISA::EmulatedTiles;

/// Activations in memory of their own, between guards.
class Rows {
 public:
  Rows(std::int64_t rows, std::int32_t cols)
      : bytes_(activation_bytes<Bf16>(rows, cols)),
        memory_(static_cast<std::byte*>(std::aligned_alloc(64, bytes_ + 64)), &std::free),
        view_(activation_rows<Bf16>(memory_.get(), rows, cols)) {
    std::memset(memory_.get(), 0xAB, bytes_ + 64);
  }
  View<Bf16> view() const { return view_; }
  bool guarded() const {
    for (std::size_t i = 0; i < 64; ++i) {
      if (memory_.get()[bytes_ + i] != std::byte{0xAB}) return false;
    }
    return true;
  }
  bool padded_with_zeros() const {
    for (std::int64_t m = 0; m < view_.rows; ++m) {
      for (std::int64_t j = view_.cols; j < view_.row_stride; ++j) {
        if (view_.row(m)[j].bits != 0) return false;
      }
    }
    return true;
  }

 private:
  std::size_t bytes_;
  std::unique_ptr<std::byte, decltype(&std::free)> memory_;
  View<Bf16> view_;
};

float wide(Bf16 value) {
  const std::uint32_t bits = static_cast<std::uint32_t>(value.bits) << 16;
  float f;
  std::memcpy(&f, &bits, sizeof f);
  return f;
}

/// Random rows that bf16 holds exactly.
Rows random_rows(std::int64_t rows, std::int32_t cols, std::uint64_t seed) {
  const auto values = random_values<float>(rows * cols, seed);
  Rows made(rows, cols);
  round_rows(View<const float>(values.data(), rows, cols), made.view());
  return made;
}

class Packed {
 public:
  Packed(View<const float> weight, bool transposed)
      : words_(static_cast<std::uint32_t*>(std::aligned_alloc(64, size(weight, transposed))), &std::free),
        weight_(pack_weight(weight, transposed, words_.get())) {}
  PackedWeight weight() const { return weight_; }

 private:
  static std::size_t size(View<const float> w, bool transposed) {
    const std::int64_t words = transposed ? packed_weight_words(w.cols, w.rows) : packed_weight_words(w.rows, w.cols);
    return static_cast<std::size_t>((words * 4 + 63) / 64 * 64);
  }
  std::unique_ptr<std::uint32_t, decltype(&std::free)> words_;
  PackedWeight weight_;
};

float as_bf16(float value) {
  Rows one(1, 1);
  round_rows(View<const float>(&value, 1, 1), one.view());
  return wide(one.view()(0, 0));
}

struct Bf16Shape {
  std::int64_t rows;
  std::int32_t in, out;
};
const Bf16Shape kBf16Shapes[] = {{1, 1, 1},      {5, 7, 3},     {16, 32, 16},  {17, 33, 17},
                                 {32, 63, 256},  {33, 256, 29}, {64, 64, 64},  {97, 300, 70},
                                 {130, 16, 130}, {600, 48, 65}, {53, 513, 33}, {0, 8, 8}};

enum class Bf16Start { none, one, per_ray, per_row };

TEST(Bf16Layers, StayWithinTheirErrorBoundForEveryShapeAndStart) {
  int cases = 0;
  for (const Bf16Shape& s : kBf16Shapes) {
    const Rows x = random_rows(s.rows, s.in, 1), mask = random_rows(s.rows, s.out, 2);
    const auto w = random_values<float>(std::int64_t{s.in} * s.out, 3),
               starts = random_values<float>((s.rows + 5) * s.out, 4);
    const View<const float> weight(w.data(), s.in, s.out);
    std::vector<float> turned(w.size()), rounded(w.size());
    for (std::size_t i = 0; i < w.size(); ++i) rounded[i] = as_bf16(w[i]);
    for (std::int32_t i = 0; i < s.in; ++i) {
      for (std::int32_t j = 0; j < s.out; ++j) turned[j * s.in + i] = w[i * s.out + j];
    }
    std::vector<std::int32_t> ray(static_cast<std::size_t>(s.rows));
    for (std::size_t i = 0; i < ray.size(); ++i) ray[i] = static_cast<std::int32_t>(i * 5 / ray.size());
    const Packed plain(weight, false), from_transpose(View<const float>(turned.data(), s.out, s.in), true);
    for (const bool transposed : {false, true}) {
      for (const Bf16Start start : {Bf16Start::none, Bf16Start::one, Bf16Start::per_ray, Bf16Start::per_row}) {
        for (int ends = 0; ends < 4; ++ends) {
          Layer<Bf16> l{.x = x.view(), .weight = (transposed ? from_transpose : plain).weight()};
          if (start == Bf16Start::one) l.start = View<const float>(starts.data(), 1, s.out);
          if (start == Bf16Start::per_row) l.start = View<const float>(starts.data(), s.rows, s.out);
          if (start == Bf16Start::per_ray) {
            l.start = View<const float>(starts.data(), 5, s.out);
            l.row_of = View<const std::int32_t>(ray.data(), s.rows, 1);
          }
          l.relu = (ends & 1) != 0;
          if ((ends & 2) != 0) l.mask = mask.view();
          const Rows y(s.rows, s.out);
          std::vector<float> exact(static_cast<std::size_t>(s.rows * (s.out + 3) + 1), 12345.0F);
          l.y = y.view();
          apply(l);
          l.y = {};
          l.exact = View<float>(exact.data(), s.rows, s.out, s.out + 3);
          apply(l);
          ASSERT_TRUE(y.guarded() && y.padded_with_zeros());
          for (std::int64_t m = 0; m < s.rows; ++m) {
            for (std::int32_t j = 0; j < s.out; ++j) {
              double sum = 0, magnitude = 0;
              if (start != Bf16Start::none) {
                const std::int64_t row = start == Bf16Start::one ? 0 : start == Bf16Start::per_row ? m : ray[m];
                sum = starts[row * s.out + j];
              }
              for (std::int32_t k = 0; k < s.in; ++k) {
                const double product =
                    static_cast<double>(wide(x.view()(m, k))) * static_cast<double>(rounded[k * s.out + j]);
                sum += product;
                magnitude += std::fabs(product);
              }
              if (l.relu) sum = std::max(sum, 0.0);
              if (!l.mask.empty() && !(wide(mask.view()(m, j)) > 0)) sum = 0;
              const float got = exact[m * (s.out + 3) + j];
              ASSERT_NEAR(got, sum, (s.in + 2) * std::ldexp(1.0, -23) * (magnitude + 1))
                  << s.rows << " x " << s.in << " x " << s.out << " at " << m << ", " << j;
              ASSERT_EQ(wide(y.view()(m, j)), as_bf16(got));
            }
            for (std::int64_t j = s.out; j < s.out + 3; ++j) ASSERT_EQ(exact[m * (s.out + 3) + j], 12345.0F);
          }
          ++cases;
        }
      }
      if (s.rows > 200) break;
    }
  }
  EXPECT_EQ(cases, (12 * 2 - 1) * 4 * 4);
}

TEST(Bf16Layers, AnElementsBitsDependOnItsOwnRowAlone) {
  const Rows x = random_rows(150, 70, 5), whole(150, 40);
  const auto w = random_values<float>(70 * 40, 6);
  const Packed weight(View<const float>(w.data(), 70, 40), false);
  apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .y = whole.view()});
  for (std::int64_t row = 0, size = 1; row < 150; row += size++) {
    const std::int64_t count = std::min(size, 150 - row);
    const Rows own(count, 70), part(count, 40);
    for (std::int64_t m = 0; m < count; ++m)
      std::memcpy(own.view().row(m), x.view().row(row + m), 2 * static_cast<std::size_t>(own.view().row_stride));
    apply(Layer<Bf16>{.x = own.view(), .weight = weight.weight(), .y = part.view()});
    for (std::int64_t m = 0; m < count; ++m)
      ASSERT_EQ(std::memcmp(part.view().row(m), whole.view().row(row + m), 80), 0) << "row " << row + m;
  }
}

TEST(Bf16Layers, WeightGradientsAddUpTheRows) {
  for (const Bf16Shape& s : kBf16Shapes) {
    const Rows x = random_rows(s.rows, s.in, 7), dz = random_rows(s.rows, s.out, 8);
    auto dw = random_values<float>(std::int64_t{s.in} * (s.out + 2), 9), db = random_values<float>(s.out, 10);
    const auto dw_before = dw, db_before = db;
    weight_gradient(x.view(), dz.view(), View<float>(dw.data(), s.in, s.out, s.out + 2),
                    View<float>(db.data(), 1, s.out));
    for (std::int32_t j = 0; j < s.out; ++j) {
      double bias = db_before[j], size = 0;
      for (std::int64_t m = 0; m < s.rows; ++m) {
        bias += static_cast<double>(wide(dz.view()(m, j)));
        size += std::fabs(static_cast<double>(wide(dz.view()(m, j))));
      }
      ASSERT_NEAR(db[j], bias, static_cast<double>(s.rows + 1) * std::ldexp(1.0, -23) * (size + 1));
      for (std::int32_t i = 0; i < s.in; ++i) {
        const auto at = static_cast<std::size_t>(i * (s.out + 2) + j);
        double sum = dw_before[at], magnitude = 0;
        for (std::int64_t m = 0; m < s.rows; ++m) {
          const double product = static_cast<double>(wide(x.view()(m, i))) * static_cast<double>(wide(dz.view()(m, j)));
          sum += product;
          magnitude += std::fabs(product);
        }
        ASSERT_NEAR(dw[at], sum, static_cast<double>(s.rows + 1) * std::ldexp(1.0, -23) * (magnitude + 1))
            << s.rows << " x " << s.in << " x " << s.out << " at " << i << ", " << j;
      }
    }
    for (std::int32_t i = 0; i < s.in; ++i) {
      for (std::int32_t j = s.out; j < s.out + 2; ++j) {
        const auto at = static_cast<std::size_t>(i * (s.out + 2) + j);
        ASSERT_EQ(dw[at], dw_before[at]) << "between the rows of d_weight";
      }
    }
  }
}

TEST(Bf16Layers, RoundToNearestEvenAndKeepWhatIsNoNumber) {
  const float inf = std::numeric_limits<float>::infinity();
  EXPECT_EQ(as_bf16(1.00390625F), 1.0F);
  EXPECT_EQ(as_bf16(1.0039064F), 1.0078125F);
  EXPECT_EQ(as_bf16(1.01171875F), 1.015625F);
  EXPECT_EQ(as_bf16(inf), inf);
  EXPECT_TRUE(std::isnan(as_bf16(std::numeric_limits<float>::quiet_NaN())));
  Rows x(1, 4);
  const float values[] = {std::numeric_limits<float>::quiet_NaN(), 1, 2, 3}, one[] = {1, 1, 1, 1};
  round_rows(View<const float>(values, 1, 4), x.view());
  const Packed weight(View<const float>(one, 4, 1), false);
  float y = 0;
  apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .relu = true, .exact = View<float>(&y, 1, 1)});
  EXPECT_TRUE(std::isnan(y));
}

TEST(Bf16Layers, SumsOfWeightedRowsAndTheirGradients) {
  for (const std::int32_t cols : {32, 64, 96, 128}) {
    const std::int64_t rows = 9;
    const Rows hidden = random_rows(rows, cols, 11), d_hidden(rows, cols);
    auto weight = random_values<float>(rows, 12), d_sum = random_values<float>(cols, 13);
    weight[3] = 0;
    std::vector<float> sum(static_cast<std::size_t>(cols), 7.0F), dots(static_cast<std::size_t>(rows), 7.0F);
    const View<const float> w(weight.data(), rows, 1);
    weighted_row_sum(w, hidden.view(), View<float>(sum.data(), 1, cols));
    weighted_row_sum_backward(w, hidden.view(), View<const float>(d_sum.data(), 1, cols),
                              View<float>(dots.data(), rows, 1), d_hidden.view());
    for (std::int32_t c = 0; c < cols; ++c) {
      double want = 0;
      for (std::int64_t k = 0; k < rows; ++k) {
        const float w_k = weight[k], d = d_sum[c];
        const float h = wide(hidden.view()(k, c));
        want += static_cast<double>(w_k) * static_cast<double>(h);
        EXPECT_EQ(wide(d_hidden.view()(k, c)), h > 0 ? as_bf16(w_k * d) : 0.0F);
      }
      EXPECT_NEAR(sum[c], want, 1e-5);
    }
    for (std::int64_t k = 0; k < rows; ++k) {
      double want = 0;
      for (std::int32_t c = 0; c < cols; ++c)
        want += static_cast<double>(wide(hidden.view()(k, c))) * static_cast<double>(d_sum[c]);
      EXPECT_NEAR(dots[k], want, 1e-4);
    }
  }
}

TEST(Bf16Layers, RowsAreRoundedThroughAMaskAndWidened) {
  for (const std::int32_t cols : {1, 7, 32, 45, 64}) {
    const std::int64_t rows = 5;
    const auto values = random_values<float>(rows * (cols + 1), 14);
    const Rows mask = random_rows(rows, cols, 15), masked(rows, cols), whole(rows, cols);
    const View<const float> from(values.data(), rows, cols, cols + 1);
    round_rows(from, whole.view());
    round_rows(from, masked.view(), mask.view());
    std::vector<float> back(static_cast<std::size_t>(rows * cols));
    widen_rows(whole.view(), View<float>(back.data(), rows, cols));
    ASSERT_TRUE(whole.guarded() && whole.padded_with_zeros() && masked.padded_with_zeros());
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t c = 0; c < cols; ++c) {
        const float want = as_bf16(from(m, c));
        EXPECT_EQ(back[m * cols + c], want);
        EXPECT_EQ(wide(masked.view()(m, c)), wide(mask.view()(m, c)) > 0 ? want : 0.0F);
      }
    }
  }
}

TEST(Bf16Layers, SumsARaysRowsInOrder) {
  const std::vector<std::int32_t> ray_of{0, 0, 2, 2, 2, 3};
  const Rows dz = random_rows(6, 70, 16);
  std::vector<float> sums(4 * 70, 5.0F);
  per_ray_sum(dz.view(), View<const std::int32_t>(ray_of.data(), 6, 1), View<float>(sums.data(), 4, 70));
  for (std::int32_t ray = 0; ray < 4; ++ray) {
    for (std::int32_t c = 0; c < 70; ++c) {
      float want = 0;
      for (std::int64_t m = 0; m < 6; ++m) {
        if (ray_of[m] == ray) want += wide(dz.view()(m, c));
      }
      EXPECT_EQ(sums[ray * 70 + c], want);
    }
  }
}

TEST(Bf16Layers, RefuseShapesThatDoNotFit) {
  const Rows x(4, 8), y(4, 8);
  const std::vector<float> w(64);
  const Packed weight(View<const float>(w.data(), 8, 8), false);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight()}), std::exception);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view().col_range(0, 7), .weight = weight.weight(), .y = y.view()}),
               std::exception);
  const View<Bf16> dense(y.view().data, 4, 8);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .y = dense}), std::exception)
      << "rows not padded";
}

// Layers on tiles with every instruction that is not the build's own written in plain C++: what a CPU without
// AVX-512 can check of them.

struct Operands {
  Operands(std::int64_t rows, std::int32_t in, std::int32_t out, bool integers)
      : x(activation_bytes<Bf16>(rows, in) / sizeof(Bf16)),
        y(activation_bytes<Bf16>(rows, out) / sizeof(Bf16)),
        weight(static_cast<std::size_t>(in * out)),
        start(static_cast<std::size_t>(rows * out)) {
    std::uint64_t seed = 1;
    const auto value = [&](std::size_t i) {
      const double u = 2 * uniform01({seed, 0, 1}, i) - 1;
      return static_cast<float>(integers ? std::round(15 * u) : u);
    };
    layer.x = activation_rows<Bf16>(reinterpret_cast<std::byte*>(x.data()), rows, in);
    layer.y = activation_rows<Bf16>(reinterpret_cast<std::byte*>(y.data()), rows, out);
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t k = 0; k < in; ++k)
        x[m * layer.x.row_stride + k] = SEMFIELD_ISA::rounded(value(static_cast<std::size_t>(m * in + k)));
    }
    for (std::vector<float>* values : {&weight, &start}) {
      ++seed;
      for (std::size_t i = 0; i < values->size(); ++i) (*values)[i] = value(i);
    }
    layer.start = View<const float>(start.data(), rows, out);
    layer.relu = true;
    words.resize(static_cast<std::size_t>(on_tiles::packed_words(in, out)));
    on_tiles::pack_weight(
        in, out, [&](std::int64_t k, std::int64_t n) { return weight[k * out + n]; }, words.data());
    layer.weight = {words.data(), in, out};
  }
  std::vector<Bf16> x, y;
  std::vector<float> weight, start;
  std::vector<std::uint32_t> words;
  Layer<Bf16> layer;
};

constexpr Bf16Shape kTileShapes[] = {{1, 9, 9},    {16, 32, 16},   {33, 65, 17},
                                     {64, 64, 64}, {40, 600, 300}, {70, 130, 29}};

TEST(LayersOnTiles, AreExactWhereNothingNeedsRounding) {
  for (const auto& [rows, in, out] : kTileShapes) {
    Operands o(rows, in, out, true);
    std::vector<float> sums(o.start.size()), gradient(static_cast<std::size_t>(in * in), 1.0F);
    o.layer.y = {};
    o.layer.exact = View<float>(sums.data(), rows, out);
    on_tiles::layer<Plain>(o.layer);
    on_tiles::weight_gradient<Plain>(o.layer.x, o.layer.x, View<float>(gradient.data(), in, in));
    for (std::int32_t i = 0; i < in; ++i) {
      for (std::int32_t j = 0; j < in; ++j) {
        double sum = 1;
        for (std::int64_t m = 0; m < rows; ++m)
          sum += static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, i))) *
                 static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, j)));
        ASSERT_EQ(gradient[i * in + j], sum) << i << ", " << j << " of " << in;
      }
    }
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t n = 0; n < out; ++n) {
        double sum = o.start[m * out + n];
        for (std::int32_t k = 0; k < in; ++k)
          sum += static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, k))) * static_cast<double>(o.weight[k * out + n]);
        ASSERT_EQ(sums[m * out + n], std::max(sum, 0.0))
            << rows << " x " << in << " x " << out << " at " << m << ", " << n;
      }
    }
  }
}

// Where the program itself runs on tiles, in registers or emulated with AVX-512, its bits are these.
TEST(LayersOnTiles, HaveTheBitsOfTheProgramsOwn) {
  if (isa() != Isa::amx_emulated && isa() != Isa::amx_bf16)
    GTEST_SKIP() << "layers run by " << isa_name(isa()) << "; SEMFIELD_ISA=amx_emulated compares";
  for (const auto& [rows, in, out] : kTileShapes) {
    Operands plain(rows, in, out, false), own(rows, in, out, false);
    on_tiles::layer<Plain>(plain.layer);
    apply(own.layer);
    EXPECT_EQ(std::memcmp(plain.y.data(), own.y.data(), plain.y.size() * sizeof(Bf16)), 0)
        << rows << " x " << in << " x " << out;
    std::vector<float> expected(plain.weight), found(plain.weight);
    on_tiles::weight_gradient<Plain>(plain.layer.x, plain.layer.y, View<float>(expected.data(), in, out));
    weight_gradient(own.layer.x, own.layer.y, View<float>(found.data(), in, out), {});
    EXPECT_EQ(std::memcmp(expected.data(), found.data(), found.size() * sizeof(float)), 0)
        << rows << " x " << in << " x " << out;
  }
}

}  // namespace
}  // namespace semfield
