// Tests of the spherical harmonics: orthonormality and known values; case C07 of tests/numerics has directions.

#include "tests/conformance/rows.h"
#include "tests/encoder_box.h"

namespace semfield {
namespace {

std::vector<double> encode(int degree, const std::vector<double>& x) {
  return testkit::EncoderBox<double>(testkit::linked_registry(), "spherical_harmonics",
                                     {{"degree", std::to_string(degree)}})
      .forward(x);
}

// Gauss-Legendre quadrature on [-1, 1]: exact for polynomials in z up to degree 9, and products of two harmonics of
// degree 4 are of degree 8.
constexpr std::pair<double, double> kNodesAndWeights[] = {{0, 0.568888888888888888889},
                                                          {0.538469310105683091036, 0.478628670499366468041},
                                                          {-0.538469310105683091036, 0.478628670499366468041},
                                                          {0.906179845938663992798, 0.236926885056189087514},
                                                          {-0.906179845938663992798, 0.236926885056189087514}};

TEST(SphericalHarmonics, AreOrthonormalOverTheSphere) {
  const int turns = 16;  // exact for e^(i m phi), |m| < 16
  std::vector<double> gram(25 * 25, 0.0);
  for (const auto& [z, weight] : kNodesAndWeights) {
    const double radius = std::sqrt(1 - z * z);
    for (int j = 0; j < turns; ++j) {
      const double phi = 2 * M_PI * (j + 0.3) / turns;
      const auto y = encode(5, {radius * std::cos(phi), radius * std::sin(phi), z});
      for (std::size_t a = 0; a < 25; ++a) {
        for (std::size_t b = 0; b < 25; ++b) gram[a * 25 + b] += weight * 2 * M_PI / turns * y[a] * y[b];
      }
    }
  }
  for (std::size_t a = 0; a < 25; ++a) {
    for (std::size_t b = 0; b < 25; ++b) EXPECT_NEAR(gram[a * 25 + b], a == b ? 1.0 : 0.0, 1e-13) << a << ' ' << b;
  }
}

TEST(SphericalHarmonics, HaveKnownLowBands) {
  const std::vector<double> d{0.36, 0.48, 0.8};
  const auto y = encode(3, d);
  const double band1 = std::sqrt(3 / (4 * M_PI));
  EXPECT_NEAR(y[0], 0.5 / std::sqrt(M_PI), 1e-15);
  EXPECT_NEAR(y[1], band1 * d[1], 1e-15);
  EXPECT_NEAR(y[2], band1 * d[2], 1e-15);
  EXPECT_NEAR(y[3], band1 * d[0], 1e-15);
  EXPECT_NEAR(y[4], 0.5 * std::sqrt(15 / M_PI) * d[0] * d[1], 1e-15);
  EXPECT_NEAR(y[6], 0.25 * std::sqrt(5 / M_PI) * (3 * d[2] * d[2] - 1), 1e-15);
  EXPECT_NEAR(y[8], 0.25 * std::sqrt(15 / M_PI) * (d[0] * d[0] - d[1] * d[1]), 1e-15);
}

TEST(SphericalHarmonics, TwoDimensionsAreNoDirection) {
  EXPECT_THROW(testkit::EncoderBox<float>(testkit::linked_registry(), "spherical_harmonics", {}, 2), Error);
}

}  // namespace
}  // namespace semfield
