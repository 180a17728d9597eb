// Metrics against values computed by hand (cases H01 to H05) and the rules of merging.
#include "eval/metrics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "compute/parallel.h"
#include "core/error.h"

namespace semfield {
namespace {

using Labels = std::vector<std::int16_t>;
using Floats = std::vector<float>;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

TEST(Psnr, IdenticalImagesAreInfinite) {  // H01
  ColorError error;
  const Floats image{0.1f, 0.5f, 0.9f};
  error.add(image, image);
  EXPECT_EQ(error.mse(), 0.0);
  EXPECT_EQ(error.psnr_db(), std::numeric_limits<double>::infinity());
}

TEST(Psnr, IsOfThePooledErrorNotTheMeanOverImages) {
  ColorError first, second;
  first.add(Floats{0, 0, 0}, Floats{0.5f, 0.5f, 0.5f});  // squared error 0.25 each
  second.add(Floats{1}, Floats{1});
  first.merge(second);
  EXPECT_DOUBLE_EQ(*first.mse(), 0.1875);
  EXPECT_NEAR(*first.psnr_db(), 7.269987279, 1e-9);
}

TEST(Psnr, NanPixelMakesTheMetricInvalidAndIsCounted) {  // H02
  ColorError error;
  error.add(Floats{0, 0, 0}, Floats{kNan, 0.5f, std::numeric_limits<float>::infinity()});
  EXPECT_EQ(error.nonfinite(), 2);
  EXPECT_FALSE(error.psnr_db().has_value());
  EXPECT_FALSE(ColorError().psnr_db().has_value());
}

TEST(Confusion, AllVoidSaysNoData) {  // H03
  ConfusionMatrix m(3);
  m.add(Labels{-1, -1, -1}, Labels{0, 1, -1});
  EXPECT_EQ(m.void_truth_px(), 3);
  EXPECT_EQ(m.scored_px(), 0);
  EXPECT_FALSE(m.total_accuracy() || m.average_accuracy() || m.miou() || m.miou_present());
  for (const ClassScore& score : m.per_class()) EXPECT_FALSE(score.iou || score.recall);
}

// H04, by hand. Truth 0 0 0 1 1 1 v 0; predicted 0 0 1 1 1 2 0 v; four classes.
//   counts: (0,0)=2 (0,1)=1 (1,1)=2 (1,2)=1; one void truth, one void prediction.
//   IoU: class 0 = 2/3, class 1 = 2/4, class 2 = 0/1 (absent in truth), class 3 has an empty union.
TEST(Confusion, AbsentClassesUnderBothDefinitions) {
  ConfusionMatrix m(4);
  m.add(Labels{0, 0, 0, 1, 1, 1, -1, 0}, Labels{0, 0, 1, 1, 1, 2, 0, -1});
  EXPECT_EQ(m.scored_px(), 6);
  EXPECT_EQ(m.void_truth_px(), 1);
  EXPECT_EQ(m.void_predicted_px(), 1);
  EXPECT_DOUBLE_EQ(*m.total_accuracy(), 4.0 / 6);
  EXPECT_DOUBLE_EQ(*m.average_accuracy(), (2.0 / 3 + 2.0 / 3) / 2);
  EXPECT_DOUBLE_EQ(*m.miou(), (2.0 / 3 + 0.5 + 0) / 3);
  EXPECT_DOUBLE_EQ(*m.miou_present(), (2.0 / 3 + 0.5) / 2);
  const std::vector<ClassScore> scores = m.per_class();
  EXPECT_DOUBLE_EQ(*scores[0].iou, 2.0 / 3);
  EXPECT_DOUBLE_EQ(*scores[2].iou, 0.0);
  EXPECT_FALSE(scores[2].recall);
  EXPECT_FALSE(scores[3].iou);
  EXPECT_EQ(scores[1].predicted_px, 3);
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
  try {
    whole.add(Labels{0, 0}, Labels{0, 2});
    FAIL() << "a label out of range was taken";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::data);
    EXPECT_NE(std::string(error.what()).find("pixel 1: predicted label 2 lies outside [0, 2)"), std::string::npos);
  }
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

TEST(Depth, NothingPredictedIsNoDataWithCoverageZero) {
  DepthError d;
  d.add(Floats{1, 2}, Floats{0, 0});
  EXPECT_FALSE(d.abs_rel());
  EXPECT_DOUBLE_EQ(*d.coverage(), 0.0);
  EXPECT_FALSE(DepthError().coverage());
  d.add(Floats{1, 1}, Floats{1, kNan});
  EXPECT_EQ(d.nonfinite(), 1);
  EXPECT_FALSE(d.rmse());
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

}  // namespace
}  // namespace semfield
