// Density activations: values, slopes, clamps, and the addresses of training noise.
#include "model/density_activation.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace semfield {
namespace {

template <class Real>
Real value(DensityActivation activation, double raw) {
  std::vector<Real> x{static_cast<Real>(raw)}, y{-1};
  density_forward<Real>(activation, View<const Real>(x.data(), 1, 1), View<Real>(y.data(), 1, 1));
  return y[0];
}

template <class Real>
Real slope(DensityActivation activation, double raw) {
  std::vector<Real> x{static_cast<Real>(raw)}, g{2}, d{-1};
  density_backward<Real>(activation, View<const Real>(x.data(), 1, 1), View<const Real>(g.data(), 1, 1),
                         View<Real>(d.data(), 1, 1));
  return d[0] / 2;
}

TEST(DensityActivation, ValuesAgainstLongDouble) {  // D16
  for (double raw = -60; raw <= 60; raw += 0.37) {
    const auto x = static_cast<long double>(static_cast<float>(raw));
    EXPECT_EQ(value<float>(DensityActivation::relu, raw), static_cast<float>(std::max(x, 0.0L)));
    const auto soft = static_cast<double>(std::max(x, 0.0L) + std::log1p(std::exp(-std::abs(x))));
    EXPECT_NEAR(value<float>(DensityActivation::softplus, raw), soft, 1e-6 * soft);
    const auto exp = static_cast<double>(std::exp(std::min(x, 15.0L)));
    EXPECT_NEAR(value<float>(DensityActivation::trunc_exp, raw), exp, 1e-6 * exp);
    const auto logistic = static_cast<double>(1 / (1 + std::exp(-x)));
    EXPECT_NEAR(slope<float>(DensityActivation::softplus, raw), logistic, 1e-6 * logistic);
  }
}

TEST(DensityActivation, ExtremesAreFiniteForwardAndBackward) {  // D17
  for (const auto activation : {DensityActivation::relu, DensityActivation::softplus, DensityActivation::trunc_exp}) {
    for (const double raw : {-1e30, -1e4, -89.0, -88.0, 0.0, 88.0, 89.0, 1e4, 1e30}) {
      EXPECT_TRUE(std::isfinite(value<float>(activation, raw))) << raw;
      EXPECT_GE(value<float>(activation, raw), 0) << raw;
      EXPECT_TRUE(std::isfinite(slope<float>(activation, raw))) << raw;
      EXPECT_GE(slope<float>(activation, raw), 0) << raw;
    }
    EXPECT_TRUE(std::isnan(value<float>(activation, NAN)));  // hidden nowhere
  }
  EXPECT_EQ(value<float>(DensityActivation::trunc_exp, 1e4), value<float>(DensityActivation::trunc_exp, kTruncExpMax));
  EXPECT_GT(slope<float>(DensityActivation::trunc_exp, 1e4), 0);  // can come down again
}

TEST(DensityActivation, SlopesAgainstDifferences) {
  for (const auto activation : {DensityActivation::relu, DensityActivation::softplus, DensityActivation::trunc_exp}) {
    for (const double raw : {-7.0, -0.4, 0.3, 2.0, 14.0}) {
      const double h = 1e-5;
      const double want = (value<double>(activation, raw + h) - value<double>(activation, raw - h)) / (2 * h);
      EXPECT_NEAR(slope<double>(activation, raw), want, 1e-8 * std::max(1.0, want)) << raw;
    }
  }
  EXPECT_EQ(slope<double>(DensityActivation::relu, 0), 0);
}

TEST(DensityNoise, IsNormalAndIndependentOfTiles) {
  const int rays = 64, n = 100;
  std::vector<std::int32_t> first;
  for (int r = 0; r <= rays; ++r) first.push_back(r * n);
  std::vector<double> whole(rays * n, 1.0), part(10 * n, 1.0);
  const RandomAddress address{3, 4, stream_id("noise")};
  add_density_noise<double>(address, 5, View<const std::int32_t>(first.data(), rays + 1, 1), 2.0,
                            View<double>(whole.data(), rays * n, 1));
  add_density_noise<double>(address, 5 + 20, View<const std::int32_t>(first.data(), 11, 1), 2.0,
                            View<double>(part.data(), 10 * n, 1));
  for (int i = 0; i < 10 * n; ++i)
    ASSERT_EQ(part[static_cast<std::size_t>(i)], whole[static_cast<std::size_t>(20 * n + i)]);
  double mean = 0, square = 0;
  for (const double x : whole) {
    mean += (x - 1) / (rays * n);
    square += (x - 1) * (x - 1) / (rays * n);
  }
  EXPECT_NEAR(mean, 0, 4 * 2.0 / std::sqrt(rays * n));
  EXPECT_NEAR(square, 4, 4 * 4 * std::sqrt(2.0 / (rays * n)));
}

}  // namespace
}  // namespace semfield
