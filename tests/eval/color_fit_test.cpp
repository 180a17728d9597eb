// Colours of a view under a map of its own.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "eval/metrics.h"

namespace semfield {
namespace {

constexpr std::int32_t kWidth = 8, kHeight = 6;

std::vector<float> picture(unsigned seed) {
  std::vector<float> colors;
  for (int i = 0; i < 3 * kWidth * kHeight; ++i)
    colors.push_back(0.5F + 0.4F * std::sin(static_cast<float>(i * (seed + 3)) * 0.37F));
  return colors;
}

// A gain, a mixture and an offset are undone to what the weak pull towards the identity leaves.
TEST(ColorFit, UndoesAnAffineMap) {
  const std::vector<float> truth = picture(1);
  std::vector<float> predicted(truth.size());
  for (std::size_t p = 0; p < truth.size(); p += 3) {
    predicted[p] = 0.8F * truth[p] + 0.05F * truth[p + 1] + 0.02F;
    predicted[p + 1] = 0.7F * truth[p + 1];
    predicted[p + 2] = 0.9F * truth[p + 2] - 0.03F;
  }
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  for (std::size_t i = 0; i < truth.size(); ++i) EXPECT_NEAR(fitted[i], truth[i], 0.02) << i;
}

// The map of a half has not seen it: a half that differs by a map of its own keeps its error.
TEST(ColorFit, AHalfIsNotScoredByAMapThatHasSeenIt) {
  const std::vector<float> truth = picture(2);
  std::vector<float> predicted = truth;
  for (std::int32_t y = 0; y < kHeight; ++y)
    for (std::int32_t x = 0; x < kWidth / 2; ++x)
      for (int c = 0; c < 3; ++c) predicted[static_cast<std::size_t>(3 * (y * kWidth + x) + c)] *= 0.5F;
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  for (std::int32_t y = 0; y < kHeight; ++y) {
    const auto left = static_cast<std::size_t>(3 * y * kWidth), right = left + 3 * (kWidth - 1);
    EXPECT_NEAR(fitted[left], 0.5 * truth[left], 0.02) << "as the right half has it: unchanged";
    EXPECT_GT(std::abs(fitted[right] - truth[right]), 0.3 * truth[right]) << "as the left half has it: doubled";
  }
}

TEST(ColorFit, LeavesOutWhatIsNotFiniteAndStandsOneColour) {
  std::vector<float> truth(picture(0).size(), 0.4F), predicted(truth.size(), 0.3F);
  predicted[5] = std::numeric_limits<float>::quiet_NaN();
  const std::vector<float> fitted = fitted_by_halves(truth, predicted, kWidth);
  EXPECT_TRUE(std::isnan(fitted[5]));
  EXPECT_NEAR(fitted[0], 0.4, 0.01);
}

}  // namespace
}  // namespace semfield
