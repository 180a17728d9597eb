// Layers: values by hand-written loops, gradients by central differences, ray terms, elementary functions.
#include "compute/layers.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>
#include <string>

#include "compute/math_functions.h"
#include "core/rng.h"

namespace semfield {
namespace {

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

TEST(Layers, ForwardIsTheFormula) {
  const Owned x(7, 5, 1), w(5, 3, 2), bias(1, 3, 3), y(7, 3);
  for (const bool relu : {false, true}) {
    apply(layer_of(x, w, bias, relu, y));
    for (int m = 0; m < 7; ++m) {
      for (int n = 0; n < 3; ++n) {
        double sum = bias.view(0, n);
        for (int k = 0; k < 5; ++k) sum += x.view(m, k) * w.view(k, n);
        if (relu) sum = std::max(sum, 0.0);
        EXPECT_NEAR(y.view(m, n), sum, 1e-14);
      }
    }
  }
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

TEST(Layers, AddedPartEqualsConcatenation) {
  const Owned x(5, 7, 12), w(7, 3, 13), bias(1, 3, 14), whole(5, 3), parts(5, 3);
  apply(layer_of(x, w, bias, true, whole));
  apply(Layer<double>{
      .x = x.read().col_range(0, 3), .weight = w.read().row_range(0, 3), .start = bias.read(), .exact = parts.view});
  apply(Layer<double>{.x = x.read().col_range(3, 4),
                      .weight = w.read().row_range(3, 4),
                      .start = parts.read(),
                      .relu = true,
                      .y = parts.view});
  EXPECT_EQ(std::memcmp(whole.values.data(), parts.values.data(), whole.values.size() * sizeof(double)), 0);
}

TEST(Layers, BiasGradientSumsRowsInOrderWhateverTheWidth) {
  for (const std::int32_t cols : {1, 3, 64, 70, 128}) {
    const Owned x(33, 1), dz(33, cols, 15), db(1, cols, 16);
    auto expected = db.values;
    for (int m = 0; m < 33; ++m) {
      for (int n = 0; n < cols; ++n) expected[n] += dz.view(m, n);
    }
    weight_gradient(x.read(), dz.read(), {}, db.view);
    EXPECT_EQ(expected, db.values);
  }
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

double ulps(float value, double truth) {
  const auto rounded = static_cast<float>(truth);
  if (value == rounded) return 0;
  const double unit = std::max(std::abs(static_cast<double>(std::nextafterf(rounded, INFINITY)) - rounded), 0x1p-149);
  return std::abs(static_cast<double>(value) - truth) / unit;
}

TEST(MathFunctions, ExpWithinTwoUlp) {
  double worst = 0;
  float worst_at = 0;
  std::vector<float> x, y;
  for (double v = -103.9; v < 88.72; v += 1.7e-4) x.push_back(static_cast<float>(v));
  for (float v : {0.0f, -0.0f, 1e-30f, -1e-8f, 1e-7f, 88.7228f, -87.3f, -103.5f}) x.push_back(v);
  y = x;
  exp_inplace(y.data(), static_cast<std::int64_t>(y.size()));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double error = ulps(y[i], std::exp(static_cast<double>(x[i])));
    if (error > worst) worst = error, worst_at = x[i];
  }
  EXPECT_LE(worst, 2.0) << "at " << worst_at;
  RecordProperty("worst_ulp", std::to_string(worst));
  float ends[] = {INFINITY, -INFINITY, 89.0f, 1e30f, -105.0f, -1e30f, NAN};
  exp_inplace(ends, 7);
  EXPECT_EQ(ends[0], INFINITY);
  EXPECT_EQ(ends[1], 0.0f);
  EXPECT_EQ(ends[2], INFINITY);
  EXPECT_EQ(ends[3], INFINITY);
  EXPECT_EQ(ends[4], 0.0f);
  EXPECT_EQ(ends[5], 0.0f);
  EXPECT_TRUE(std::isnan(ends[6]));
}

TEST(MathFunctions, OneMinusExpKeepsItsRelativeError) {
  std::vector<float> tau, x;
  for (double t = 1e-8; t < 1e8; t *= 1.0003) tau.push_back(static_cast<float>(t));
  for (double t = -20; t < 88; t += 1.1e-3) tau.push_back(static_cast<float>(-t));  // expm1 of positive arguments too
  for (float t : tau) x.push_back(-t);
  expm1_inplace(x.data(), static_cast<std::int64_t>(x.size()));
  double worst = 0;
  for (std::size_t i = 0; i < tau.size(); ++i) {
    const double truth = std::expm1(-static_cast<double>(tau[i]));
    if (truth != 0) worst = std::max(worst, std::abs(x[i] - truth) / std::abs(truth));
  }
  EXPECT_LE(worst, 2.4e-7);
  RecordProperty("worst_relative_1e9", std::to_string(worst * 1e9));
  float ends[] = {0.0f, -0.0f, -INFINITY, INFINITY, -1e30f, NAN, 1e-40f};
  expm1_inplace(ends, 7);
  EXPECT_EQ(ends[0], 0.0f);
  EXPECT_EQ(ends[1], 0.0f);
  EXPECT_EQ(ends[2], -1.0f);
  EXPECT_EQ(ends[3], INFINITY);
  EXPECT_EQ(ends[4], -1.0f);
  EXPECT_TRUE(std::isnan(ends[5]));
  EXPECT_EQ(ends[6], 1e-40f);
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

template <class Real>
void expect_sines(double tolerance) {
  for (const Real frequency : {Real(1), Real(30)}) {
    std::vector<Real> z, slope;
    for (Real v = Real(-40); v < Real(40); v += Real(0.013)) z.push_back(v);
    slope.resize(z.size());
    auto y = z, alone = z;
    const auto n = static_cast<std::int64_t>(z.size());
    sine_inplace(y.data(), n, frequency, slope.data());
    sine_inplace(alone.data(), n, frequency, static_cast<Real*>(nullptr));
    EXPECT_EQ(alone, y);
    for (std::size_t i = 0; i < z.size(); ++i) {
      const double phase = static_cast<double>(frequency) * static_cast<double>(z[i]);
      EXPECT_NEAR(y[i], std::sin(phase), tolerance) << phase;
      EXPECT_NEAR(slope[i], static_cast<double>(frequency) * std::cos(phase),
                  tolerance * static_cast<double>(frequency))
          << phase;
    }
  }
}

TEST(MathFunctions, SinesAndTheirSlopes) {
  expect_sines<float>(1.5e-7);
  expect_sines<double>(1e-12);
  float ends[] = {NAN, INFINITY, -INFINITY, 1e30f, 0.0f};
  sine_inplace(ends, 5, 30.0f, static_cast<float*>(nullptr));
  for (int i = 0; i < 3; ++i) EXPECT_TRUE(std::isnan(ends[i])) << i;
  EXPECT_LE(std::abs(ends[3]), 1.0f);
  EXPECT_EQ(ends[4], 0.0f);
}

TEST(MathFunctions, SigmoidAndSoftplusAtTheEnds) {
  EXPECT_EQ(sigmoid(0.0), 0.5);
  EXPECT_EQ(sigmoid(1e4), 1.0);
  EXPECT_EQ(sigmoid(-1e4), 0.0);
  EXPECT_NEAR(sigmoid(-30.0), std::exp(-30.0), 1e-26);
  EXPECT_EQ(softplus(1e4), 1e4);
  EXPECT_NEAR(softplus(-30.0), std::exp(-30.0), 1e-26);
  EXPECT_NEAR(softplus(0.0), std::log(2.0), 1e-16);
  std::vector<float> x;
  for (float v = -95; v < 95; v += 0.11f) x.push_back(v);
  auto y = x;
  sigmoid_inplace(y.data(), static_cast<std::int64_t>(y.size()));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double truth = 1 / (1 + std::exp(-static_cast<double>(x[i])));
    EXPECT_NEAR(y[i], truth, 3e-7 * truth + 1e-45);
  }
  y = x;
  softplus_inplace(y.data(), static_cast<std::int64_t>(y.size()));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double truth = softplus(static_cast<double>(x[i]));
    EXPECT_NEAR(y[i], truth, 4e-7 * truth + 3e-45) << x[i];
  }
  float ends[] = {INFINITY, -INFINITY, NAN, 1e30f, -1e30f, 0.0f};
  softplus_inplace(ends, 6);
  EXPECT_EQ(ends[0], INFINITY);
  EXPECT_EQ(ends[1], 0.0f);
  EXPECT_TRUE(std::isnan(ends[2]));
  EXPECT_EQ(ends[3], 1e30f);
  EXPECT_EQ(ends[4], 0.0f);
  EXPECT_FLOAT_EQ(ends[5], 0.693147181f);
}

TEST(RowReductions, AgreeWithPlainLoopsForEveryLength) {
  for (std::int64_t n = 1; n < 70; ++n) {
    std::vector<float> x(static_cast<std::size_t>(n));
    double sum = 0;
    for (std::int64_t i = 0; i < n; ++i) {
      x[i] = static_cast<float>((i * 37 + 11) % 64) - 40;
      sum += static_cast<double>(x[i]);
    }
    EXPECT_EQ(largest_of(x.data(), n), *std::max_element(x.begin(), x.end()));
    EXPECT_EQ(sum_of(x.data(), n), sum);  // whole numbers: exact in any order
    EXPECT_TRUE(all_finite(x.data(), n));
    for (const float bad : {HUGE_VALF, -HUGE_VALF, std::nanf("")}) {
      std::vector<float> broken = x;
      broken[n / 2] = bad;
      EXPECT_FALSE(all_finite(broken.data(), n));
    }
  }
  EXPECT_EQ(sum_of<float>(nullptr, 0), 0);
}

}  // namespace
}  // namespace semfield
