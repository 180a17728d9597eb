// Tests of the one-blob encoder against long double references: values, slopes, the cube's rim, refusals.
#include <algorithm>
#include <cmath>

#include "core/rng.h"
#include "tests/conformance/rows.h"
#include "tests/encoder_box.h"
#include "tests/says.h"

namespace semfield {
namespace {

template <class Real>
testkit::EncoderBox<Real> box(int bins, std::int32_t in_dims = 3) {
  return {testkit::linked_registry(), "one_blob", {{"bins", std::to_string(bins)}}, in_dims};
}

template <class Real>
std::vector<Real> encode(int bins, const std::vector<double>& x) {
  return box<Real>(bins).forward(x);
}

template <class Real>
std::vector<Real> slopes(int bins, const std::vector<double>& x, const std::vector<Real>& dy) {
  return box<Real>(bins).backward(x, dy);
}

/// Coordinates within [0, 1] with all bits of a double in use, both faces among them.
std::vector<double> coordinates(int rows) {
  std::vector<double> x{0, 1, 0.5};
  const RandomAddress where{7, 0, stream_id("one_blob_test")};
  while (x.size() < 3 * static_cast<std::size_t>(rows)) {
    const PhiloxBlock b = random_block(where, x.size());
    x.push_back(((std::uint64_t{b.v[0]} << 21) | (b.v[1] >> 11)) * 0x1p-53);
  }
  return x;
}

/// From coordinate x to the middle of bin b, in standard deviations.
long double distance(double x, int b, int bins) { return (b + 0.5L) - static_cast<long double>(x) * bins; }

constexpr int kBins[] = {2, 3, 16, 17, 49, 64};

template <class Real>
double largest_error(int bins) {
  const std::vector<double> x = coordinates(500);
  const std::vector<Real> y = encode<Real>(bins, x);
  long double worst = 0;
  for (std::size_t i = 0; i < y.size(); ++i) {
    const auto k = static_cast<std::size_t>(bins);
    const long double z = distance(x[i / k], static_cast<int>(i % k), bins);
    worst = std::max(worst, std::fabs(y[i] - std::exp(-z * z / 2)));
  }
  return static_cast<double>(worst);
}

// 64 bins from coordinates rounded to single precision would be off by 2e-6.
TEST(OneBlob, ValuesAreTheGaussianAtTheMiddlesOfBins) {
  for (const int bins : kBins) EXPECT_LE(largest_error<float>(bins), 1.2e-7) << bins;
  for (const int bins : {2, 16, 64}) EXPECT_LE(largest_error<double>(bins), 2e-16) << bins;
  // k x is rounded: by 2^-48 at most, times a slope of e^(-1/2).
  for (const int bins : {3, 17, 49, 63}) EXPECT_LE(largest_error<double>(bins), 2.4e-15) << bins;
}

TEST(OneBlob, SlopesAreExact) {
  for (const int bins : kBins) {
    const std::vector<double> x = coordinates(500);
    std::vector<float> dy(x.size() * static_cast<std::size_t>(bins));
    for (std::size_t i = 0; i < dy.size(); ++i) dy[i] = static_cast<float>(std::cos(2.1 * static_cast<double>(i)));
    const std::vector<double> dy64(dy.begin(), dy.end());
    const auto single = slopes<float>(bins, x, dy);
    const auto twin = slopes<double>(bins, x, dy64);
    for (std::size_t i = 0; i < x.size(); ++i) {
      long double want = 0;
      for (int b = 0; b < bins; ++b) {
        const long double z = distance(x[i], b, bins);
        want += bins * z * std::exp(-z * z / 2) * dy[i * static_cast<std::size_t>(bins) + static_cast<std::size_t>(b)];
      }
      // Relative to the largest slope of a value, k e^(-1/2), of which a few overlap.
      EXPECT_NEAR(twin[i], want, 2e-14 * bins) << bins << " bins, x = " << x[i];
      EXPECT_NEAR(single[i], want, 3e-7 * bins) << bins << " bins, x = " << x[i];
    }
  }
}

TEST(OneBlob, OutsideTheCubeCountsAsItsRim) {
  const double above = std::nextafter(1.0, 2.0), below = -std::numeric_limits<double>::min();
  const std::vector<float> rim = encode<float>(16, {0, 1, 0.4});
  for (const double out : {1e-9, 0.2, 1e300}) {
    EXPECT_EQ(encode<float>(16, {-out, 1 + out, 0.4}), rim) << out;
    std::vector<float> dy(48, 0.F);
    for (std::size_t b = 0; b < 48; ++b) dy[b] = static_cast<float>(b + 1);
    const auto dx = slopes<float>(16, {-out, 1 + out, 0.4}, dy);
    EXPECT_EQ(dx[0], 0) << out;
    EXPECT_EQ(dx[1], 0) << out;
    EXPECT_NE(dx[2], 0) << out;
  }
  EXPECT_EQ(encode<float>(16, {below, above, 0.4}), rim);
  // At the rim itself the blob is cut in half, symmetric on both faces, and has the slope towards the inside.
  for (std::size_t b = 0; b < 16; ++b) EXPECT_EQ(rim[b], rim[31 - b]) << b;
  EXPECT_FLOAT_EQ(rim[0], std::exp(-0.125F));
  const auto inwards = slopes<float>(16, {0, 1, 0.5}, std::vector<float>(48, 1.F));
  EXPECT_GT(inwards[0], 1.F);
  EXPECT_LT(inwards[1], -1.F);
  EXPECT_EQ(slopes<float>(16, {below, above, 0.5}, std::vector<float>(48, 1.F))[0], 0);
  EXPECT_EQ(slopes<float>(16, {below, above, 0.5}, std::vector<float>(48, 1.F))[1], 0);
}

template <class Real>
void expect_tails_of_zero() {
  const Real least = std::numeric_limits<Real>::min();
  int zeros = 0, tiny = 0;
  for (int i = 0; i < 1000; ++i) {
    const double at = i / 1000.0;
    for (const Real v : encode<Real>(64, {at, at, at})) {
      ASSERT_TRUE(v == 0 || (v >= least && v <= 1)) << at << ' ' << v;
      zeros += v == 0 ? 1 : 0;
      tiny += v != 0 && v < 16 * least ? 1 : 0;
    }
  }
  EXPECT_GT(zeros, 0);
  EXPECT_GT(tiny, 0) << "values down to the least normal number";
}

TEST(OneBlob, TailsEndInZeroNotInSubnormalNumbers) {
  expect_tails_of_zero<float>();
  expect_tails_of_zero<double>();
}

TEST(OneBlob, RefusesWhatCannotBeEncoded) {
  for (const double bad : {static_cast<double>(NAN), HUGE_VAL, -HUGE_VAL}) {
    std::vector<double> x(3 * 70, 0.5);
    x[3 * 66 + 1] = bad;
    x[3 * 68] = bad;
    EXPECT_HAS(error_of([&] { encode<float>(16, x); }), "row 66 ") << bad;
  }
  EXPECT_THROW(box<float>(16, 2), Error);
  EXPECT_EQ(box<float>(16).encoder().traits().domain, Domain::unit_cube);
}

}  // namespace
}  // namespace semfield
