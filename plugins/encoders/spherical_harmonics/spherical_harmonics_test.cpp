// Tests of the spherical harmonics encoder: orthonormality, known values, gradients, refusals.
#include "encoders/spherical_harmonics/spherical_harmonics.h"

#include <gtest/gtest.h>

namespace semfield {
namespace {

template <class Real>
SphericalHarmonics<Real> make(int degree, std::int32_t in_dims = 3) {
  static const KernelTables tables = [] {
    KernelTables t;
    spherical_harmonics_kernels(t);
    return t;
  }();
  EncoderBuild build{.in_dims = in_dims};
  return SphericalHarmonics<Real>({degree}, build, tables);
}

template <class Real>
std::vector<Real> encode(const SphericalHarmonics<Real>& encoder, const std::vector<double>& x) {
  const auto rows = static_cast<std::int64_t>(x.size() / 3);
  const std::int32_t cols = encoder.traits().out_dims;
  std::vector<Real> y(static_cast<std::size_t>(rows * cols));
  encoder.forward({}, {}, View<const double>(x.data(), rows, 3), View<Real>(y.data(), rows, cols));
  return y;
}

/// Nodes and weights of Gauss-Legendre quadrature on [-1, 1] by Newton's method.
void gauss_legendre(int n, std::vector<double>& nodes, std::vector<double>& weights) {
  for (int i = 0; i < n; ++i) {
    double z = std::cos(M_PI * (i + 0.75) / (n + 0.5));
    double slope = 0;
    for (int turn = 0; turn < 100; ++turn) {
      double p = 1, before = 0;
      for (int l = 1; l <= n; ++l) {
        const double next = ((2 * l - 1) * z * p - (l - 1) * before) / l;
        before = p;
        p = next;
      }
      slope = n * (z * p - before) / (z * z - 1);
      z -= p / slope;
    }
    nodes.push_back(z);
    weights.push_back(2 / ((1 - z * z) * slope * slope));
  }
}

TEST(SphericalHarmonics, AreOrthonormalOverTheSphere) {
  const auto encoder = make<double>(5);
  std::vector<double> nodes, weights;
  gauss_legendre(8, nodes, weights);  // exact for polynomials in z up to degree 15
  const int turns = 16;               // exact for e^(i m phi), |m| < 16
  std::vector<double> gram(25 * 25, 0.0);
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const double radius = std::sqrt(1 - nodes[i] * nodes[i]);
    for (int j = 0; j < turns; ++j) {
      const double phi = 2 * M_PI * (j + 0.3) / turns;
      const auto y = encode<double>(encoder, {radius * std::cos(phi), radius * std::sin(phi), nodes[i]});
      for (std::size_t a = 0; a < 25; ++a) {
        for (std::size_t b = 0; b < 25; ++b) gram[a * 25 + b] += weights[i] * 2 * M_PI / turns * y[a] * y[b];
      }
    }
  }
  for (std::size_t a = 0; a < 25; ++a) {
    for (std::size_t b = 0; b < 25; ++b) EXPECT_NEAR(gram[a * 25 + b], a == b ? 1.0 : 0.0, 1e-13) << a << ' ' << b;
  }
}

TEST(SphericalHarmonics, HaveKnownLowBands) {
  const std::vector<double> d{0.36, 0.48, 0.8};
  const auto y = encode<double>(make<double>(3), d);
  const double band1 = std::sqrt(3 / (4 * M_PI));
  EXPECT_NEAR(y[0], 0.5 / std::sqrt(M_PI), 1e-15);
  EXPECT_NEAR(y[1], band1 * d[1], 1e-15);
  EXPECT_NEAR(y[2], band1 * d[2], 1e-15);
  EXPECT_NEAR(y[3], band1 * d[0], 1e-15);
  EXPECT_NEAR(y[4], 0.5 * std::sqrt(15 / M_PI) * d[0] * d[1], 1e-15);
  EXPECT_NEAR(y[6], 0.25 * std::sqrt(5 / M_PI) * (3 * d[2] * d[2] - 1), 1e-15);
  EXPECT_NEAR(y[8], 0.25 * std::sqrt(15 / M_PI) * (d[0] * d[0] - d[1] * d[1]), 1e-15);
}

// Unsoeld's theorem: the squares of a band add up to (2l + 1) / (4 pi) in every direction, so also on the axes.
TEST(SphericalHarmonics, BandsHaveConstantPower) {
  const auto encoder = make<float>(5);
  for (const std::vector<double>& d : std::vector<std::vector<double>>{
           {0, 0, 1}, {0, 0, -1}, {1, 0, 0}, {0, -1, 0}, {0.6, 0, -0.8}, {0.36, 0.48, 0.8}}) {
    const auto y = encode<float>(encoder, d);
    for (int l = 0; l < 5; ++l) {
      double power = 0;
      for (int i = l * l; i < (l + 1) * (l + 1); ++i) power += static_cast<double>(y[i]) * y[i];
      EXPECT_NEAR(power, (2 * l + 1) / (4 * M_PI), 1e-6) << "band " << l;
    }
  }
}

TEST(SphericalHarmonics, GradientMatchesDifferences) {
  for (int degree = 1; degree <= 5; ++degree) {
    const auto encoder = make<double>(degree);
    const std::int32_t n = degree * degree;
    std::vector<double> d{0.36, -0.48, 0.8}, dy(static_cast<std::size_t>(n)), dx(3);
    for (std::int32_t i = 0; i < n; ++i) dy[i] = std::cos(1.7 * i + 0.2);
    encoder.backward({}, {}, View<const double>(d.data(), 1, 3), View<const double>(dy.data(), 1, n),
                     View<double>(dx.data(), 1, 3));
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const double h = 1e-5;
      auto plus = d, minus = d;
      plus[axis] += h;
      minus[axis] -= h;
      const auto yp = encode<double>(encoder, plus);
      const auto ym = encode<double>(encoder, minus);
      double expected = 0;
      for (std::size_t i = 0; i < dy.size(); ++i) expected += dy[i] * (yp[i] - ym[i]) / (2 * h);
      EXPECT_NEAR(dx[axis], expected, 1e-8) << "degree " << degree << " axis " << axis;
    }
  }
}

TEST(SphericalHarmonics, TwoDimensionsAreNoDirection) { EXPECT_THROW(make<float>(2, 2), Error); }

}  // namespace
}  // namespace semfield
