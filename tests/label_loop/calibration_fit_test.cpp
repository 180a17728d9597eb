// The temperature by clicks that were held back: which may be, what a few wrong ones do, and what settles nothing.
#include "serve/calibration_fit.h"

#include <gtest/gtest.h>

#include <cmath>

namespace semfield {
namespace {

// Probabilities of `classes` of which class 0 has `top`; the truth is class 0 or another.
HeldBack click(double top, bool right, double counts = 1, std::size_t classes = 6) {
  HeldBack held;
  held.probability.assign(classes, static_cast<float>((1 - top) / static_cast<double>(classes - 1)));
  held.probability[0] = static_cast<float>(top);
  held.truth = right ? 0 : 1;
  held.counts = counts;
  return held;
}

std::vector<HeldBack> clicks(int right, int wrong, double top) {
  std::vector<HeldBack> held;
  for (int i = 0; i < right; ++i) held.push_back(click(top, true));
  for (int i = 0; i < wrong; ++i) held.push_back(click(top, false));
  return held;
}

TEST(CalibrationFit, ManyClicksSettleIt) {
  // 95 % sure and right seven times in ten: the temperature that makes 0.7 of it, nearly.
  const double t = fit_temperature(clicks(700, 300, 0.95)).value_or(0);
  const double top = std::pow(0.95, 1 / t), other = 5 * std::pow(0.01, 1 / t);
  EXPECT_NEAR(top / (top + other), 0.7, 0.1);
  EXPECT_GT(t, 1.5);
  EXPECT_LT(fit_temperature(clicks(95, 5, 0.6)).value_or(9), 0.8) << "too careful";
}

TEST(CalibrationFit, FewClicksStayNearOne) {
  EXPECT_FALSE(fit_temperature(clicks(5, 2, 0.95)).has_value());
  const double few = fit_temperature(clicks(7, 3, 0.95)).value_or(0),
               many = fit_temperature(clicks(700, 300, 0.95)).value_or(0);
  EXPECT_GT(few, 1);
  EXPECT_LT(few, many);
}

// A slip, or a place that no other click resembles: the network is certain of another class there.
TEST(CalibrationFit, OneCertainMistakeDoesNotOutweighTheOthers) {
  std::vector<HeldBack> held = clicks(18, 0, 0.95);
  const double without = fit_temperature(held).value_or(0);
  HeldBack slip = click(1 - 1e-9, false, 8);  // and it stands for much of the surface
  held.push_back(slip);
  const double with = fit_temperature(held).value_or(0);
  EXPECT_GT(without, 0);
  EXPECT_LT(with, 2) << "was " << without;
}

TEST(CalibrationFit, AnOptimumAtABoundIsNone) { EXPECT_FALSE(fit_temperature(clicks(0, 500, 0.95)).has_value()); }

TEST(CalibrationFit, ClassesWithFewClicksAreNeverHeldBackAndTheOthersAreDealtOut) {
  const std::vector<std::int16_t> classes{0, 1, 0, 2, 0, 1, 0, 0, 2, 1, 2, 2};
  const std::vector<int> folds = calibration_folds(classes);
  ASSERT_EQ(folds.size(), classes.size());
  std::vector<int> of_0, of_2;
  for (std::size_t i = 0; i < classes.size(); ++i) {
    if (classes[i] == 1) {
      EXPECT_EQ(folds[i], -1) << "three clicks";
    } else {
      (classes[i] == 0 ? of_0 : of_2).push_back(folds[i]);
    }
  }
  EXPECT_EQ(of_0, (std::vector<int>{0, 1, 2, 3, 4}));
  EXPECT_EQ(of_2, (std::vector<int>{2, 3, 4, 0}));
}

}  // namespace
}  // namespace semfield
