// Metrics against values computed by hand, and the rules of merging. Cases H01 to H05 of tests/numerics have what is
// absent or bad.
#include "eval/metrics.h"

#include <cmath>
#include <limits>
#include <random>

#include "compute/parallel.h"
#include "core/error.h"
#include "tests/says.h"

namespace semfield {
namespace {

using Labels = std::vector<std::int16_t>;
using Floats = std::vector<float>;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

TEST(Psnr, IsOfThePooledErrorNotTheMeanOverImages) {
  ColorError first, second;
  first.add(Floats{0, 0, 0}, Floats{0.5f, 0.5f, 0.5f});  // squared error 0.25 each
  second.add(Floats{1}, Floats{1});
  first.merge(second);
  EXPECT_DOUBLE_EQ(*first.mse(), 0.1875);
  EXPECT_NEAR(*first.psnr_db(), 7.269987279, 1e-9);
}

TEST(Confusion, MergeEqualsOneAddAndRangeIsChecked) {
  const Labels truth{0, 1, 1, 0, -1, 1}, predicted{0, 1, 0, 1, 0, 1};
  ConfusionMatrix whole(2), first(2), second(2);
  whole.add(truth, predicted);
  first.add(std::span(truth).first(2), std::span(predicted).first(2));
  second.add(std::span(truth).subspan(2), std::span(predicted).subspan(2));
  first.merge(second);
  for (int t = 0; t < 2; ++t) {
    for (int p = 0; p < 2; ++p) EXPECT_EQ(whole.count(t, p), first.count(t, p));
  }
  EXPECT_HAS(error_of(ErrorKind::data,
                      [&] {
                        whole.add(Labels{0, 0}, Labels{0, 2});
                      }),
             "pixel 1: predicted label 2 lies outside [0, 2)");
  EXPECT_EQ(whole.scored_px(), 5);
}

TEST(Depth, ByHandWithMaskedPixels) {  // H05
  DepthError d(10);
  // Pairs: (2, 3) and (4, 4) are scored; prediction 0 is missing; truth 0, NaN and 12 (beyond far) are not valid.
  d.add(Floats{2, 4, 5, 0, kNan, 12}, Floats{3, 4, 0, 1, 1, 12});
  EXPECT_EQ(d.valid_truth_px(), 3);
  EXPECT_EQ(d.scored_px(), 2);
  EXPECT_DOUBLE_EQ(*d.abs_rel(), 0.25);
  EXPECT_DOUBLE_EQ(*d.abs_diff(), 0.5);
  EXPECT_DOUBLE_EQ(*d.sq_rel(), 0.25);
  EXPECT_DOUBLE_EQ(*d.rmse(), std::sqrt(0.5));
  EXPECT_DOUBLE_EQ(*d.delta(1), 0.5);  // 1.5 is over 1.25 and under 1.5625
  EXPECT_DOUBLE_EQ(*d.delta(2), 1.0);
  EXPECT_DOUBLE_EQ(*d.coverage(), 2.0 / 3);
}

TEST(Ssim, KnownValues) {
  constexpr int kSize = 16;
  Floats a(kSize * kSize), black(a.size(), 0.0f), white(a.size(), 1.0f);
  for (std::size_t i = 0; i < a.size(); ++i) a[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
  EXPECT_DOUBLE_EQ(*ssim(a, a, kSize, kSize, 1), 1.0);
  // Constant images: only the luminance term, C1 / (1 + C1).
  EXPECT_NEAR(*ssim(black, white, kSize, kSize, 1), 1e-4 / (1 + 1e-4), 1e-12);
  EXPECT_FALSE(ssim(Floats(100), Floats(100), 10, 10, 1));
  a[5] = kNan;
  EXPECT_FALSE(ssim(a, black, kSize, kSize, 1));
}

TEST(Ssim, WindowsThatHoldAMaskedPixelDoNotCount) {
  constexpr int kWide = 30, kHigh = 20;
  Floats a(kWide * kHigh), b(a.size());
  for (std::size_t i = 0; i < a.size(); ++i) a[i] = b[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
  std::vector<std::uint8_t> used(a.size(), 1);
  for (std::size_t y = 0; y < kHigh; ++y) {  // a column that is wrong, and masked
    b[y * kWide + 15] = 0;
    used[y * kWide + 15] = 0;
  }
  EXPECT_LT(*ssim(a, b, kWide, kHigh, 1), 0.99);
  EXPECT_DOUBLE_EQ(*ssim(a, b, kWide, kHigh, 1, used), 1.0);
  used.assign(a.size(), 1);
  used[7 * kWide + 15] = 0;  // one of its pixels alone
  EXPECT_LT(*ssim(a, b, kWide, kHigh, 1, used), 1.0);
  used.assign(a.size(), 0);
  EXPECT_FALSE(ssim(a, b, kWide, kHigh, 1, used)) << "nothing counts";
}

// The same definition written directly: two-dimensional weights, two passes.
double plain_ssim(const Floats& x, const Floats& y, int width, int height, int channels) {
  double total = 0;
  int windows = 0;
  for (int c = 0; c < channels; ++c) {
    for (int v = 5; v < height - 5; ++v) {
      for (int u = 5; u < width - 5; ++u, ++windows) {
        const auto sum = [&](auto&& value) {
          double weights = 0, s = 0;
          for (int j = -5; j <= 5; ++j) {
            for (int i = -5; i <= 5; ++i) {
              const double w = std::exp(-(i * i + j * j) / (2 * 1.5 * 1.5));
              weights += w;
              s += w * value(static_cast<std::size_t>(((v + j) * width + u + i) * channels + c));
            }
          }
          return s / weights;
        };
        const double mx = sum([&](std::size_t i) { return double(x[i]); });
        const double my = sum([&](std::size_t i) { return double(y[i]); });
        const double vx = sum([&](std::size_t i) { return (x[i] - mx) * (x[i] - mx); });
        const double vy = sum([&](std::size_t i) { return (y[i] - my) * (y[i] - my); });
        const double vxy = sum([&](std::size_t i) { return (x[i] - mx) * (y[i] - my); });
        total += (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4));
      }
    }
  }
  return total / windows;
}

TEST(Ssim, AgreesWithThePlainDefinitionOnAnyThreadCount) {
  constexpr int kWidth = 19, kHeight = 14;
  Floats x(kWidth * kHeight * 3), y(x.size());
  for (std::size_t i = 0; i < x.size(); ++i) {
    x[i] = static_cast<float>((i * 7919) % 101) / 100.0f;
    y[i] = 0.7f * x[i] + static_cast<float>((i * 104729) % 31) / 100.0f;
  }
  const int before = thread_count();
  set_thread_count(1);
  const double one = *ssim(x, y, kWidth, kHeight, 3);
  set_thread_count(3);
  const double three = *ssim(x, y, kWidth, kHeight, 3);
  set_thread_count(before);
  EXPECT_NEAR(one, plain_ssim(x, y, kWidth, kHeight, 3), 1e-12);
  EXPECT_EQ(one, three);
}

TEST(Calibration, ByHand) {
  Calibration c;
  // Confidences 0.9 (right), 0.9 (wrong), 0.6 (right); one void pixel.
  c.add(Floats{0.9f, 0.1f, 0.9f, 0.1f, 0.4f, 0.6f, 1, 0}, 2, Labels{0, 1, 1, -1});
  EXPECT_EQ(c.scored_px(), 3);
  EXPECT_NEAR(*c.ece(), (std::abs(1 - 1.8) + std::abs(1 - 0.6)) / 3, 1e-7);
  EXPECT_NEAR(*c.nll(), -(std::log(0.9) + std::log(0.1) + std::log(0.6)) / 3, 1e-7);
  EXPECT_FALSE(Calibration().ece());
}

TEST(Calibration, ZeroProbabilityStaysFinite) {
  Calibration c;
  c.add(Floats{1, 0}, 2, Labels{1});
  EXPECT_NEAR(*c.nll(), -std::log(1.17549435e-38), 1e-6);
  EXPECT_DOUBLE_EQ(*c.ece(), 1.0);
}

TEST(Entropy, OneHotIsExactlyZeroAndUniformIsLnC) {
  EXPECT_EQ(entropy_nats(Floats{0, 1, 0}), 0.0);
  EXPECT_NEAR(entropy_nats(Floats{0.25f, 0.25f, 0.25f, 0.25f}), std::log(4.0), 1e-12);
}

// Entropy of groups of pixels against every pair compared by itself.

constexpr std::int16_t kV = -1;  // void

// Mann-Whitney: pairs in which the second has more, ties one half.
double every_pair(const Floats& low, const Floats& high) {
  double won = 0;
  for (const float h : high) {
    for (const float l : low) won += h > l ? 1 : h == l ? 0.5 : 0;
  }
  return won / (static_cast<double>(low.size()) * static_cast<double>(high.size()));
}

EntropyHistogram histogram(const Floats& values) {
  EntropyHistogram out;
  for (const float v : values) out.add(v);
  return out;
}

// Entropies of 24 classes as a field gives them: many orders of magnitude, most near 0, some exactly there.
Floats entropies(std::size_t count, double centre, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> decades(centre, 2);
  Floats out(count);
  for (float& v : out) v = static_cast<float>(std::min(std::log(24.0), std::exp(decades(random)) - 1e-7));
  return out;
}

TEST(EntropyAuroc, AgreesWithEveryPairWithinItsBound) {
  for (const auto& [low_at, high_at] : {std::pair{-6.0, -1.0}, {-3.0, -3.0}, {-1.0, -6.0}, {-14.0, -12.0}}) {
    const Floats low = entropies(3000, low_at, 1), high = entropies(700, high_at, 2);
    const std::optional<Auroc> found = auroc(histogram(low), histogram(high));
    ASSERT_TRUE(found);
    EXPECT_LE(std::abs(found->value - every_pair(low, high)), found->error) << low_at << ", " << high_at;
    EXPECT_LT(found->error, low_at < -10 ? 0.03 : 0.0003) << "entropies below 2^-24 are ties";
  }
}

TEST(EntropyAuroc, ByHand) {
  const auto of = [](const Floats& low, const Floats& high) { return auroc(histogram(low), histogram(high))->value; };
  EXPECT_EQ(of({0.1F, 0.2F}, {0.5F, 3.0F}), 1);
  EXPECT_EQ(of({0.5F, 3.0F}, {0.1F, 0.2F}), 0);
  EXPECT_EQ(of({0.5F, 0, 0}, {0.5F, 0, 0}), 0.5) << "ties count one half";
  EXPECT_EQ(of({0, 1}, {0.5F, 2}), 0.75);
  EXPECT_EQ(of({-1e-9F, 0}, {1e-9F, 0}), 0.5) << "rounding below 0 is 0";
  EXPECT_EQ(of({0x1p-25F}, {0x1p-24F}), 1) << "the first bin ends at 2^-24";
  EXPECT_EQ(of({1}, {1 + 1 / 2048.0F}), 1) << "2,048 bins an octave";
  EXPECT_EQ(of({1}, {1 + 1 / 3000.0F}), 0.5);
  EXPECT_EQ(of({6.9F}, {6.94F}), 1) << "ln 1024 lies inside";
  EXPECT_EQ(of({9}, {100}), 0.5) << "above 8 nats all are one bin";
  EXPECT_EQ(auroc(histogram({1, 1, 2}), histogram({1, 3}))->error, 0.5 * 2 / 6) << "half of the pairs in one bin";
}

TEST(EntropyAuroc, IsNoneWithoutOneOfTheGroupsOrWithNan) {
  const EntropyHistogram some = histogram({0.5F}), none;
  EXPECT_FALSE(auroc(some, none));
  EXPECT_FALSE(auroc(none, some));
  EXPECT_FALSE(none.mean());
  const EntropyHistogram broken = histogram({0.5F, std::numeric_limits<float>::quiet_NaN()});
  EXPECT_EQ(broken.pixels(), 1);
  EXPECT_EQ(broken.nonfinite(), 1);
  EXPECT_FALSE(broken.mean());
  EXPECT_FALSE(auroc(some, broken));
  EXPECT_FALSE(auroc(broken, some));
}

TEST(EntropyAuroc, MergesInAnyOrderToTheSameBits) {
  const Floats low = entropies(999, -4, 3), high = entropies(500, -2, 4);
  std::vector<EntropyHistogram> parts;
  for (std::size_t begin = 0; begin < low.size(); begin += 111)
    parts.push_back(histogram(Floats(low.begin() + static_cast<std::ptrdiff_t>(begin),
                                     low.begin() + static_cast<std::ptrdiff_t>(begin + 111))));
  EntropyHistogram forward, backward;
  for (auto part = parts.begin(); part != parts.end(); ++part) forward.merge(*part);
  for (auto part = parts.rbegin(); part != parts.rend(); ++part) backward.merge(*part);
  const Auroc whole = *auroc(histogram(low), histogram(high));
  EXPECT_EQ(auroc(forward, histogram(high))->value, whole.value);
  EXPECT_EQ(auroc(backward, histogram(high))->value, whole.value);
  EXPECT_EQ(forward.pixels(), 999);
  EXPECT_NEAR(*forward.mean(), *histogram(low).mean(), 1e-12);
}

TEST(PredictedEntropy, DropsVoidAndSplitsByWhetherTheLabelIsRight) {
  PredictedEntropy found;
  // right 0.1, wrong 2, void truth, void prediction, right 1, wrong 0.5
  found.add(Floats{0.1F, 2, 0.7F, 0.7F, 1, 0.5F}, Labels{0, 1, 0, kV, 2, 0}, Labels{0, 0, kV, 0, 2, 2});
  EXPECT_EQ(found.right.pixels(), 2);
  EXPECT_EQ(found.wrong.pixels(), 2);
  EXPECT_NEAR(*found.wrong.mean(), 1.25, 1e-7);
  EXPECT_EQ(found.detects_wrong()->value, 0.75);
  PredictedEntropy all_right;
  all_right.add(Floats{0.1F, 0.2F}, Labels{0, 1}, Labels{0, 1});
  EXPECT_FALSE(all_right.detects_wrong()) << "nothing to detect";
  PredictedEntropy all_wrong;
  all_wrong.add(Floats{0.1F, 0.2F}, Labels{1, 0}, Labels{0, 1});
  EXPECT_FALSE(all_wrong.detects_wrong());
}

TEST(GivenEntropy, GroupsPixelsByTheLabelTheyTrainedWith) {
  GivenEntropy found;
  // right 0.1, wrong 2, unlabelled 1, void truth (labelled, and not), right 0.3
  found.add(Floats{0.1F, 2, 1, 0.7F, 0.7F, 0.3F}, Labels{0, 1, kV, 0, kV, 2}, Labels{0, 0, 0, kV, kV, 2});
  EXPECT_EQ(found.pixels(), 4);
  EXPECT_NEAR(*found.right.mean(), 0.2, 1e-7);
  EXPECT_EQ(*found.wrong.mean(), 2);
  EXPECT_EQ(*found.none.mean(), 1);
  EXPECT_EQ(found.detects_wrong()->value, 1);
  EXPECT_NEAR(found.detects_none()->value, 2.0 / 3, 1e-15) << "1 nat against 0.1, 2 and 0.3";
  GivenEntropy frame;  // without labels
  frame.add(Floats{3, 0.2F}, {}, Labels{1, kV});
  EXPECT_FALSE(frame.detects_none());
  found.merge(frame);
  EXPECT_EQ(found.none.pixels(), 2);
  EXPECT_EQ(*found.none.mean(), 2);
  EXPECT_NEAR(found.detects_none()->value, 5.0 / 6, 1e-15);
}

}  // namespace
}  // namespace semfield
