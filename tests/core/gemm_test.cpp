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
using Mapped = Eigen::Map<const Matrix<Real>, 0, Eigen::Stride<Eigen::Dynamic, Eigen::Dynamic>>;

template <class Real>
Mapped<Real> mapped(const Real* data, std::int64_t rows, std::int64_t cols, std::int64_t row, std::int64_t col = 1) {
  return Mapped<Real>(data, rows, cols, {row, col});
}

double number(double value) { return value; }
double number(Bf16 value) {
  return static_cast<double>(std::bit_cast<float>(static_cast<std::uint32_t>(value.bits) << 16));
}
/// The numbers of a view.
template <class T>
Matrix<double> dense(View<T> view) {
  return Matrix<double>::NullaryExpr(view.rows, view.cols, [&](std::int64_t r, std::int64_t c) {
    return number(view(r, static_cast<std::int32_t>(c)));
  });
}

/// The first element that is farther from the wanted one than its tolerance, or is no number; "" where none is.
template <class Got, class Want, class Tolerance>
std::string far_off(const Got& got, const Want& want, const Tolerance& tolerance) {
  for (std::int64_t i = 0; i < want.rows(); ++i) {
    for (std::int64_t j = 0; j < want.cols(); ++j) {
      const auto is = static_cast<double>(got(i, j)), should = static_cast<double>(want(i, j));
      if (!(std::abs(is - should) <= static_cast<double>(tolerance(i, j))))
        return std::to_string(i) + ", " + std::to_string(j) + ": " + std::to_string(is) + " for " +
               std::to_string(should);
    }
  }
  return "";
}
template <class Got, class Want>
std::string far_off(const Got& got, const Want& want, double tolerance) {
  return far_off(got, want, Matrix<double>::Constant(want.rows(), want.cols(), tolerance));
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
          for (std::int64_t j = 0; j < s.n; ++j) c[i * c_row + j] = static_cast<Real>(0.01) * static_cast<Real>(i - j);
          const auto from = mapped(extra.data(), 4, s.n, s.n);
          if (start == Start::accumulate) expected.row(i) = mapped(c.data(), s.m, s.n, c_row).row(i);
          if (start == Start::bias) expected.row(i) = from.row(0);
          if (start == Start::row_term) expected.row(i) = from.row(row_of[i]);
        }
        if (s.k > 0) expected += mapped(a.data(), s.m, s.k, a_row, a_col) * mapped(b.data(), s.k, s.n, b_row);
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
        ASSERT_EQ(far_off(mapped(c.data(), s.m, s.n, c_row), expected, tolerance), "")
            << "m " << s.m << " n " << s.n << " k " << s.k << " layout " << layout;
        ASSERT_TRUE((mapped(c.data() + s.n, s.m, c_row - s.n, c_row).array() == kGuard).all());
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

using Owned = Matrix<double>;
Owned zeros(std::int64_t rows, std::int64_t cols) { return Owned::Zero(rows, cols); }
Owned random(std::int64_t rows, std::int64_t cols, std::uint64_t seed) {
  return mapped(random_values<double>(rows * cols, seed).data(), rows, cols, cols);
}
View<double> view(Owned& of) { return {of.data(), of.rows(), static_cast<std::int32_t>(of.cols())}; }
View<const double> read(const Owned& of) { return {of.data(), of.rows(), static_cast<std::int32_t>(of.cols())}; }

/// The gradient of `loss` by central differences over the elements of `values`.
template <class Loss>
Owned differences(Owned& values, Loss loss) {
  constexpr double kStep = 1e-6;
  Owned gradient = zeros(values.rows(), values.cols());
  for (std::int64_t i = 0; i < values.size(); ++i) {
    double& value = values.data()[i];
    const double kept = value;
    value = kept + kStep;
    const double up = loss();
    value = kept - kStep;
    gradient.data()[i] = (up - loss()) / (2 * kStep);
    value = kept;
  }
  return gradient;
}

/// y = x W + bias, and the ReLU.
Layer<double> layer_of(const Owned& x, const Owned& w, const Owned& bias, bool relu, Owned& y) {
  return {.x = read(x), .weight = read(w), .start = read(bias), .relu = relu, .y = view(y)};
}

TEST(Layers, GradientsMatchCentralDifferences) {
  for (const bool relu : {false, true}) {
    Owned x = random(9, 6, 4), w = random(6, 5, 5), bias = random(1, 5, 6), y = zeros(9, 5), weight_t = zeros(5, 6);
    const Owned seed = random(9, 5, 7);
    const auto loss = [&] {
      apply(layer_of(x, w, bias, relu, y));
      return y.cwiseProduct(seed).sum();
    };
    loss();
    transpose(read(w), view(weight_t));
    Owned dz = seed, dx = zeros(9, 6), dw = zeros(6, 5), db = zeros(1, 5);
    if (relu) relu_backward(read(y), view(dz));
    Layer<double> back{.x = read(dz), .weight = read(weight_t), .exact = view(dx)};
    apply(back);
    weight_gradient(read(x), read(dz), view(dw), view(db));
    EXPECT_EQ(far_off(dx, differences(x, loss), 1e-8), "");
    EXPECT_EQ(far_off(dw, differences(w, loss), 1e-8), "");
    EXPECT_EQ(far_off(db, differences(bias, loss), 1e-8), "");
    // Gradients of parameters add up; activations are assigned unless the layer starts from them.
    const Owned twice_w = 2 * dw, twice_x = 2 * dx;
    back.start = read(dx);
    apply(back);
    weight_gradient(read(x), read(dz), view(dw), view(db));
    EXPECT_EQ(far_off(dw, twice_w, 1e-12), "");
    EXPECT_EQ(far_off(dx, twice_x, 1e-12), "");
  }
}

TEST(Layers, RayTermEqualsConcatenatedInputWithGradients) {
  const std::vector<std::int32_t> ray_of{0, 0, 0, 1, 1, 3, 3, 3, 3, 3, 3};  // ray 2 has no sample
  const std::int64_t samples = std::ssize(ray_of), rays = 4;
  const View<const std::int32_t> ray_view(ray_of.data(), samples, 1);
  Owned x = random(samples, 4, 8), w = random(4, 6, 9), term = random(rays, 6, 10), y = zeros(samples, 6);
  const Owned seed = random(samples, 6, 11);
  const auto loss = [&] {
    Layer<double> layer = layer_of(x, w, term, true, y);
    layer.row_of = ray_view;
    apply(layer);
    return y.cwiseProduct(seed).sum();
  };
  loss();
  Owned sums = x * w;
  for (std::int64_t m = 0; m < samples; ++m) sums.row(m) += term.row(ray_of[m]);
  EXPECT_EQ(far_off(y, sums.cwiseMax(0.0), 1e-14), "");
  Owned dz = seed, d_term = Owned::Constant(rays, 6, std::numeric_limits<double>::quiet_NaN());
  relu_backward(read(y), view(dz));
  per_ray_sum(read(dz), ray_view, view(d_term));
  EXPECT_EQ(far_off(d_term, differences(term, loss), 1e-8), "");
  EXPECT_EQ(d_term.row(2), zeros(1, 6));
}

TEST(Layers, RefuseShapesThatDoNotFit) {
  Owned x = zeros(2, 3), w = zeros(3, 2), wrong = zeros(4, 2), bias = zeros(1, 2), y = zeros(2, 2), few = zeros(3, 2);
  const Layer<double> good = layer_of(x, w, bias, false, y);
  EXPECT_NO_THROW(apply(good));
  const auto refused = [&](void (*spoil)(Layer<double>&, View<double>), Owned& with) {
    Layer<double> layer = good;
    spoil(layer, view(with));
    EXPECT_THROW(apply(layer), std::exception);
  };
  refused([](Layer<double>& l, View<double> v) { l.weight = v; }, wrong);
  refused([](Layer<double>& l, View<double> v) { l.start = v; }, few);
  refused([](Layer<double>& l, View<double> v) { l.mask = v; }, few);
  refused([](Layer<double>& l, View<double> v) { l.exact = v; }, y);
  refused([](Layer<double>& l, View<double>) { l.y = {}; }, y);
  EXPECT_THROW(weight_gradient(read(x), read(few), view(w), view(bias)), std::exception);
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

float wide(Bf16 value) { return static_cast<float>(number(value)); }

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
    const Matrix<float> turned = mapped(w.data(), s.in, s.out, s.out).transpose(),
                        rounded = mapped(w.data(), s.in, s.out, s.out).unaryExpr(&as_bf16);
    const Matrix<double> products = dense(x.view()) * rounded.cast<double>(),
                         sizes = dense(x.view()).cwiseAbs() * rounded.cwiseAbs().cast<double>();
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
          Matrix<double> sums = products;
          for (std::int64_t m = 0; m < s.rows && start != Bf16Start::none; ++m) {
            const std::int64_t row = start == Bf16Start::one ? 0 : start == Bf16Start::per_row ? m : ray[m];
            sums.row(m) += mapped(starts.data(), row + 1, s.out, s.out).row(row).cast<double>();
          }
          if (l.relu) sums = sums.cwiseMax(0.0);
          if (!l.mask.empty()) sums = (dense(mask.view()).array() > 0).select(sums, 0.0);
          const Matrix<float> got = mapped(exact.data(), s.rows, s.out, s.out + 3);
          const double step = (s.in + 2) * std::ldexp(1.0, -23);
          ASSERT_EQ(far_off(got, sums, step * (sizes.array() + 1)), "") << s.rows << " x " << s.in << " x " << s.out;
          ASSERT_EQ(dense(y.view()), got.unaryExpr(&as_bf16).cast<double>());
          ASSERT_TRUE((mapped(exact.data() + s.out, s.rows, 3, s.out + 3).array() == 12345.0F).all());
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
    const Matrix<double> rows = dense(x.view()), of = dense(dz.view());
    const double step = static_cast<double>(s.rows + 1) * std::ldexp(1.0, -23);
    const Matrix<double> bias = mapped(db_before.data(), 1, s.out, s.out).cast<double>() + of.colwise().sum(),
                         bias_sizes = of.cwiseAbs().colwise().sum();
    ASSERT_EQ(far_off(mapped(db.data(), 1, s.out, s.out), bias, step * (bias_sizes.array() + 1)), "");
    const auto before = mapped(dw_before.data(), s.in, s.out + 2, s.out + 2),
               now = mapped(dw.data(), s.in, s.out + 2, s.out + 2);
    const Matrix<double> sums = before.leftCols(s.out).cast<double>() + rows.transpose() * of,
                         sizes = rows.cwiseAbs().transpose() * of.cwiseAbs();
    ASSERT_EQ(far_off(now, sums, step * (sizes.array() + 1)), "") << s.rows << " x " << s.in << " x " << s.out;
    ASSERT_EQ(now.rightCols(2), before.rightCols(2)) << "between the rows of d_weight";
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
    const Matrix<double> h = dense(hidden.view()), by_row = dense(w),
                         by_column = mapped(d_sum.data(), 1, cols, cols).cast<double>();
    EXPECT_EQ(far_off(mapped(sum.data(), 1, cols, cols), by_row.transpose() * h, 1e-5), "");
    EXPECT_EQ(far_off(mapped(dots.data(), rows, 1, 1), h * by_column.transpose(), 1e-4), "");
    for (std::int64_t k = 0; k < rows; ++k)
      for (std::int32_t c = 0; c < cols; ++c)
        EXPECT_EQ(wide(d_hidden.view()(k, c)), h(k, c) > 0 ? as_bf16(weight[k] * d_sum[c]) : 0.0F);
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
      : x(rows, in),
        y(rows, out),
        weight(random_values<float>(std::int64_t{in} * out, 2)),
        start(random_values<float>(rows * out, 3)) {
    std::vector<float> given = random_values<float>(rows * in, 1);
    for (std::vector<float>* values : {&given, &weight, &start})
      for (float& value : *values) value = integers ? std::round(15 * value) : value;
    round_rows(View<const float>(given.data(), rows, in), x.view());
    layer.x = x.view();
    layer.y = y.view();
    layer.start = View<const float>(start.data(), rows, out);
    layer.relu = true;
    words.resize(static_cast<std::size_t>(on_tiles::packed_words(in, out)));
    on_tiles::pack_weight(
        in, out, [&](std::int64_t k, std::int64_t n) { return weight[k * out + n]; }, words.data());
    layer.weight = {words.data(), in, out};
  }
  Rows x, y;
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
    const Matrix<double> x = dense(o.layer.x), weight = mapped(o.weight.data(), in, out, out).cast<double>();
    EXPECT_EQ(mapped(gradient.data(), in, in, in).cast<double>(), ((x.transpose() * x).array() + 1).matrix()) << in;
    EXPECT_EQ(mapped(sums.data(), rows, out, out).cast<double>(), (dense(o.layer.start) + x * weight).cwiseMax(0.0))
        << rows << " x " << in << " x " << out;
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
    const View<Bf16> y = plain.y.view();
    EXPECT_EQ(std::memcmp(y.data, own.y.view().data, static_cast<std::size_t>(y.rows * y.row_stride) * sizeof(Bf16)), 0)
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
