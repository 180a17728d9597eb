// Tests of the frequency encoder; cases C01 to C06 of tests/numerics have its errors.
#include "encoders/frequency/frequency.h"

#include <algorithm>

#include "tests/conformance/rows.h"
#include "tests/encoder_box.h"
#include "tests/says.h"

namespace semfield {
namespace {

template <class Real>
testkit::EncoderBox<Real> make(int bands, Angular angular, bool input = true, std::int32_t dims = 3,
                               Arithmetic arithmetic = Arithmetic::float64) {
  return testkit::EncoderBox<Real>(std::make_unique<Frequency<Real>>(FrequencyParams{bands, input, angular, arithmetic},
                                                                     EncoderBuild{.in_dims = dims},
                                                                     testkit::linked_registry().kernels()));
}

TEST(Frequency, LayoutIsInputThenSinesThenCosinesPerBand) {
  const std::vector<double> x{0.1, -0.2, 0.3};
  const auto y = make<double>(2, Angular::radian).forward(x);
  ASSERT_EQ(y.size(), 15u);
  for (std::size_t c = 0; c < 3; ++c) {
    EXPECT_EQ(y[c], x[c]);
    EXPECT_NEAR(y[3 + c], std::sin(x[c]), 1e-15);
    EXPECT_NEAR(y[6 + c], std::cos(x[c]), 1e-15);
    EXPECT_NEAR(y[9 + c], std::sin(2 * x[c]), 1e-15);
    EXPECT_NEAR(y[12 + c], std::cos(2 * x[c]), 1e-15);
  }
  EXPECT_EQ(make<float>(10, Angular::radian).out_dims(), 63);
  EXPECT_EQ(make<float>(4, Angular::radian, false).out_dims(), 24);
  EXPECT_EQ(make<double>(0, Angular::radian).forward(x), x);
}

TEST(Frequency, ExactQuarterTurns) {
  const auto y = make<float>(3, Angular::pi, false, 1).forward({0.0, 0.5, 1.0, -0.5});
  EXPECT_EQ(y, (std::vector<float>{0, 1, 0, 1, 0, 1, 1, 0, 0, -1, 0, 1, 0, -1, 0, 1, 0, 1, -1, 0, 0, -1, 0, 1}));
}

TEST(Frequency, RefusesWhatCannotBeBuilt) {
  Diagnostics diagnostics;
  validate(FrequencyParams{0, false, Angular::radian}, diagnostics);
  EXPECT_EQ(diagnostics.error_count(), 1);
  EXPECT_THROW(make<float>(1, Angular::pi, true, 17), Error);
}

TEST(Frequency, KnowsItsEffectiveBands) {
  EXPECT_EQ(effective_bands(0x1p-24, Angular::pi), 19);  // a 10 m room scaled by 1/10, fp32
  EXPECT_EQ(effective_bands(0x1p-53, Angular::pi), 48);
  EXPECT_EQ(effective_bands(0.1, Angular::radian), 0);
  EXPECT_EQ(effective_bands(5, Angular::radian), 0);
  EXPECT_THROW(effective_bands(0, Angular::radian), Error);
}

TEST(Frequency, SaysHowManyBandsAreEffective) {
  EncoderBuild build{.largest_coordinate = 1};
  const auto said = [&](int bands, Arithmetic arithmetic, Angular angular) {
    FrequencyParams p{.frequencies = bands, .angular = angular, .arithmetic = arithmetic};
    std::vector<std::string> lines;
    choose(p, build, lines);
    EXPECT_EQ(p.frequencies, bands) << "it only says";
    return lines.empty() ? std::string() : lines[0];
  };
  EXPECT_EQ(said(19, Arithmetic::float32, Angular::pi), "");
  EXPECT_EQ(said(40, Arithmetic::float64, Angular::pi), "");
  EXPECT_HAS(said(40, Arithmetic::float32, Angular::pi), "effective_bands is 19 of 40", "arithmetic: float64");
  EXPECT_HAS(said(21, Arithmetic::naive, Angular::radian), "effective_bands is 20 of 21");
  build.largest_coordinate = 0x1p20;  // a scene far from the origin, unscaled
  EXPECT_HAS(said(40, Arithmetic::float64, Angular::pi), "effective_bands is 28 of 40");
  build.largest_coordinate = 0;  // unknown
  EXPECT_EQ(said(40, Arithmetic::naive, Angular::pi), "");
}

// The arms of the rounding experiment: a rounded coordinate reduced exactly, and the plain fp32 program.
TEST(Frequency, ArmsRoundWhatTheySay) {
  const std::vector<double> x{0.73120349871234, -0.98711112223334, 0.1};
  const int bands = 20;
  for (const Angular angular : {Angular::radian, Angular::pi}) {
    const double a = angular == Angular::pi ? 3.141592653589793 : 1.0;
    std::vector<double> x32;
    for (const double v : x) x32.push_back(static_cast<float>(v));
    const auto exact = make<float>(bands, angular, false).forward(x32);
    EXPECT_EQ(make<float>(bands, angular, false, 3, Arithmetic::float32).forward(x), exact);
    const auto plain = make<float>(bands, angular, false, 3, Arithmetic::naive).forward(x);
    double apart = 0;
    for (int k = 0; k < bands; ++k) {
      for (std::size_t c = 0; c < 3; ++c) {
        const float product = static_cast<float>(std::ldexp(a, k)) * static_cast<float>(x[c]);
        const std::size_t at = 6 * static_cast<std::size_t>(k) + c;
        EXPECT_NEAR(plain[at], std::sin(static_cast<double>(product)), 2e-7) << k;
        EXPECT_NEAR(plain[at + 3], std::cos(static_cast<double>(product)), 2e-7) << k;
        apart = std::max(apart, std::fabs(static_cast<double>(plain[at]) - exact[at]));
      }
    }
    // 2^k x is exact in fp32, 2^k pi x is not: rounding doubles its phase error a band.
    EXPECT_TRUE(angular == Angular::radian ? apart < 1e-6 : apart > 1e-2) << apart;
  }
}

}  // namespace
}  // namespace semfield
