// Tests of the frequency encoder against long double references, beside cases C01 to C06 of tests/numerics.
#include "encoders/frequency/frequency.h"

#include <algorithm>

#include "compute/parallel.h"
#include "core/rng.h"
#include "tests/says.h"

namespace semfield {
namespace {

template <class Real>
Frequency<Real> make(int bands, Angular angular, bool input = true, std::int32_t dims = 3) {
  static const KernelTables tables = [] {
    KernelTables t;
    frequency_kernels(t);
    return t;
  }();
  EncoderBuild build{.in_dims = dims};
  return Frequency<Real>({bands, input, angular}, build, tables);
}

template <class Real>
std::vector<Real> encode(const Frequency<Real>& encoder, const std::vector<double>& x) {
  const EncoderTraits shape = encoder.traits();
  const auto rows = static_cast<std::int64_t>(x.size()) / shape.in_dims;
  std::vector<Real> y(static_cast<std::size_t>(rows * shape.out_dims));
  encoder.forward({}, {}, View<const double>(x.data(), rows, shape.in_dims),
                  View<Real>(y.data(), rows, shape.out_dims));
  return y;
}

/// Random values of both signs, magnitudes spread evenly over powers of two from 2^low to 2^high.
std::vector<double> spread(int count, int low, int high) {
  std::vector<double> x;
  const RandomAddress where{7, 0, stream_id("frequency_test")};
  for (int i = 0; i < count; ++i) {
    const PhiloxBlock b = random_block(where, static_cast<std::uint64_t>(i));
    const double mantissa = 1 + ((std::uint64_t{b.v[0]} << 20) | (b.v[1] >> 12)) * 0x1p-52;
    const int exponent = low + static_cast<int>(b.v[2] % static_cast<unsigned>(high - low));
    x.push_back(std::ldexp((b.v[3] & 1) != 0 ? mantissa : -mantissa, exponent));
  }
  return x;
}

/// The angle 2^k a x, exactly reduced for pi and left to the library's own exact reduction for radian.
long double angle(double x, int k, Angular angular) {
  const long double scaled = std::ldexp(static_cast<long double>(x), k);
  return angular == Angular::pi ? std::fmod(scaled, 2.0L) * 3.14159265358979323846264338327950288L : scaled;
}

template <class Real>
double largest_error(const std::vector<double>& x, int bands, Angular angular) {
  const auto encoder = make<Real>(bands, angular, false, 1);
  const auto y = encode<Real>(encoder, x);
  long double worst = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    for (int k = 0; k < bands; ++k) {
      const std::size_t at = i * 2 * static_cast<std::size_t>(bands) + 2 * static_cast<std::size_t>(k);
      worst = std::max(worst, std::fabs(y[at] - std::sin(angle(x[i], k, angular))));
      worst = std::max(worst, std::fabs(y[at + 1] - std::cos(angle(x[i], k, angular))));
    }
  }
  ::testing::Test::RecordProperty(angular == Angular::pi ? "error_pi_in_1e-18" : "error_radian_in_1e-18",
                                  std::to_string(static_cast<std::int64_t>(worst * 1e18L)));
  return static_cast<double>(worst);
}

TEST(Frequency, DoubleIsTheOracle) {
  EXPECT_LE(largest_error<double>(spread(4000, -20, 10), 20, Angular::radian), 3e-16);
  EXPECT_LE(largest_error<double>(spread(4000, -20, 20), 40, Angular::radian), 1e-14);
  EXPECT_LE(largest_error<double>(spread(4000, -20, 20), 40, Angular::pi), 3e-16);
}

TEST(Frequency, LayoutIsInputThenSinesThenCosinesPerBand) {
  const std::vector<double> x{0.1, -0.2, 0.3};
  const auto y = encode<double>(make<double>(2, Angular::radian), x);
  ASSERT_EQ(y.size(), 15u);
  for (std::size_t c = 0; c < 3; ++c) {
    EXPECT_EQ(y[c], x[c]);
    EXPECT_NEAR(y[3 + c], std::sin(x[c]), 1e-15);
    EXPECT_NEAR(y[6 + c], std::cos(x[c]), 1e-15);
    EXPECT_NEAR(y[9 + c], std::sin(2 * x[c]), 1e-15);
    EXPECT_NEAR(y[12 + c], std::cos(2 * x[c]), 1e-15);
  }
  EXPECT_EQ(make<float>(10, Angular::radian).traits().out_dims, 63);
  EXPECT_EQ(make<float>(4, Angular::radian, false).traits().out_dims, 24);
  EXPECT_EQ(encode<double>(make<double>(0, Angular::radian), x), x);
}

TEST(Frequency, ExactQuarterTurns) {
  const auto y = encode<float>(make<float>(3, Angular::pi, false, 1), {0.0, 0.5, 1.0, -0.5});
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
  for (const int bands : {4, 10, 19}) {
    EXPECT_EQ(said(bands, Arithmetic::float32, Angular::pi), "");
    EXPECT_EQ(said(bands, Arithmetic::float64, Angular::pi), "");
  }
  EXPECT_EQ(said(40, Arithmetic::float64, Angular::pi), "");
  const std::string warning = said(40, Arithmetic::float32, Angular::pi);
  EXPECT_EQ(warning.rfind("warning: effective_bands is 19 of 40: ", 0), 0u) << warning;
  EXPECT_HAS(warning, "set arithmetic: float64");
  EXPECT_EQ(said(40, Arithmetic::naive, Angular::pi).rfind("warning: effective_bands is 18 of 40", 0), 0u);
  EXPECT_EQ(said(21, Arithmetic::naive, Angular::radian).rfind("warning: effective_bands is 20 of 21", 0), 0u);
  build.largest_coordinate = 0x1p20;  // a scene far from the origin, unscaled
  EXPECT_EQ(said(40, Arithmetic::float64, Angular::pi).rfind("warning: effective_bands is 28 of 40", 0), 0u);
  build.largest_coordinate = 0;  // unknown
  EXPECT_EQ(said(40, Arithmetic::naive, Angular::pi), "");
}

// The count holds: below it a band of the naive program is within 0.1 or so, two above it is not.
TEST(Frequency, TheCountIsThatOfTheNaiveProgram) {
  KernelTables tables;
  frequency_kernels(tables);
  const Frequency<float> naive({24, false, Angular::pi, Arithmetic::naive}, EncoderBuild{}, tables);
  std::vector<double> x;
  for (int i = 0; i < 3000; ++i) x.push_back(0.5 + 0.5 * std::sin(1.7 * i));
  const auto plain = encode<float>(naive, x), exact = encode<float>(make<float>(24, Angular::pi, false), x);
  const auto worst = [&](int band) {
    double apart = 0;
    for (std::size_t row = 0; row < x.size() / 3; ++row) {
      for (std::size_t c = 0; c < 6; ++c) {
        const std::size_t at = row * 144 + 6 * static_cast<std::size_t>(band) + c;
        apart = std::max(apart, std::fabs(static_cast<double>(plain[at]) - static_cast<double>(exact[at])));
      }
    }
    return apart;
  };
  const int bands = effective_bands(coordinate_error(Arithmetic::naive, Angular::pi, 1), Angular::pi);
  EXPECT_LT(worst(bands - 1), 0.1);
  EXPECT_GT(worst(bands + 2), 0.1);
}

// The arms of the rounding experiment: a rounded coordinate reduced exactly, and the plain fp32 program.
TEST(Frequency, ArmsRoundWhatTheySay) {
  const std::vector<double> x{0.73120349871234, -0.98711112223334, 0.1};
  KernelTables tables;
  frequency_kernels(tables);
  const int bands = 20;
  for (const Angular angular : {Angular::radian, Angular::pi}) {
    const double a = angular == Angular::pi ? 3.141592653589793 : 1.0;
    const Frequency<float> rounded({bands, false, angular, Arithmetic::float32}, EncoderBuild{}, tables);
    const Frequency<float> naive({bands, false, angular, Arithmetic::naive}, EncoderBuild{}, tables);
    std::vector<double> x32;
    for (const double v : x) x32.push_back(static_cast<float>(v));
    const auto exact = encode<float>(make<float>(bands, angular, false), x32);
    EXPECT_EQ(encode<float>(rounded, x), exact);
    const auto plain = encode<float>(naive, x);
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
