// The error model of simulated predictions: probabilities, what each error does, and about how many errors there are.
#include <algorithm>
#include <clocale>
#include <cmath>
#include <set>

#include "tests/labels/degradation_testing.h"

namespace semfield {
namespace {

using namespace testing_degrade;
using Labels = std::vector<std::int16_t>;

Case room(int frames = 3) {
  Case c = scene_of(12);
  for (int f = 0; f < frames; ++f) add_blocks(c, 96, 72, static_cast<std::uint64_t>(f));
  return c;
}

double accuracy(const Case& clean, const Case& c) {
  double right = 0, all = 0;
  for (std::size_t f = 0; f < c.labels.size(); ++f) {
    for (std::size_t p = 0; p < clean.labels[f].hard.size(); ++p) {
      if (clean.labels[f].hard[p] == kVoid) continue;
      all += 1;
      right += (c.labels[f].soft.empty() ? c.labels[f].hard[p] : c.labels[f].soft.argmax(p)) == clean.labels[f].hard[p];
    }
  }
  return right / all;
}

TEST(SimulatedPredictions, RowsAreProbabilitiesAndHardOutputIsTheirMaximum) {
  Case soft = room(), hard = room();
  soft.apply(*step("simulated_predictions"));
  hard.apply(*step("simulated_predictions", "{output: hard}"));
  std::vector<float> row(12);
  for (std::size_t f = 0; f < soft.labels.size(); ++f) {
    ASSERT_TRUE(soft.labels[f].hard.empty());
    ASSERT_EQ(soft.labels[f].soft.classes(), 12);
    for (std::size_t p = 0; p < soft.labels[f].soft.pixels(); ++p) {
      soft.labels[f].soft.row(p, row);
      double sum = 0;
      for (const float x : row) sum += static_cast<double>(x);
      ASSERT_NEAR(sum, soft.scene.frames[f].label[p] == kVoid ? 0.0 : 1.0, 0.003);  // 12 roundings to 11 bits
      ASSERT_EQ(soft.labels[f].soft.argmax(p), hard.labels[f].hard[p]);
    }
  }
}

TEST(SimulatedPredictions, WithoutStrengthNothingIsWrong) {
  Case c = room();
  const StepFacts facts = c.apply(*step("simulated_predictions", "{strength: 0, output: hard}"));
  EXPECT_TRUE(same_labels(c.labels, room().labels));
  EXPECT_EQ(fact(facts, "pixel accuracy"), "1.000000");
  EXPECT_EQ(fact(facts, "simulated"), "true");
}

// Facts go into files, which are the same whatever the program around has set.
TEST(SimulatedPredictions, FactsDoNotDependOnTheLocale) {
  if (std::setlocale(LC_ALL, "de_DE.UTF-8") == nullptr)
    GTEST_SKIP() << "the locale de_DE.UTF-8 is not installed here: no comma was tried";
  Case c = room();
  const StepFacts facts = c.apply(*step("simulated_predictions", "{strength: 0, output: hard}"));
  std::setlocale(LC_ALL, "C");
  EXPECT_EQ(fact(facts, "pixel accuracy"), "1.000000");
}

TEST(SimulatedPredictions, ConfidenceFollowsTheSoftmaxAndDepth) {
  // 12 classes, evidence 4, no error: e^4 / (e^4 + 11); at depth 3 of half depth 3 evidence 2.
  for (const auto& [half, evidence] : std::vector<std::pair<std::string, double>>{{"0", 4.0}, {"3", 2.0}}) {
    Case c = scene_of(12);
    c.add(2, 1, {4, kVoid}, {}, {3.0F, 3.0F});
    for (std::int64_t& n : c.scene.class_pixels[0]) n = 1;
    c.apply(*step("simulated_predictions", "{strength: 0, evidence: 4, depth_half_m: " + half + "}"));
    std::vector<float> row(12);
    c.labels[0].soft.row(0, row);
    EXPECT_NEAR(row[4], std::exp(evidence) / (std::exp(evidence) + 11), 1e-3);
    EXPECT_NEAR(row[5], 1 / (std::exp(evidence) + 11), 1e-4);
  }
}

TEST(SimulatedPredictions, ClassesThatTheSceneLacksHaveProbabilityZero) {
  Case c = scene_of(12);
  c.add(2, 1, {4, 7});
  c.apply(*step("simulated_predictions"));
  std::vector<float> row(12);
  c.labels[0].soft.row(0, row);
  for (std::size_t k = 0; k < 12; ++k) EXPECT_EQ(row[k] > 0, k == 4 || k == 7) << k;
}

TEST(SimulatedPredictions, RegionsAreMistakenAsAWholeForFewClassesAndAlikeInAllFrames) {
  Case c = room(20);
  const Case clean = c;
  c.apply(*step("simulated_predictions",
                "{output: hard, noise: 0, boundary_width: 0, overlap: 0, similar: 2, region_error: 0.3}"));
  std::vector<std::set<std::int16_t>> taken_for(12);
  int blocks = 0, mistaken = 0;
  for (std::size_t f = 0; f < c.labels.size(); ++f) {
    for (int y = 0; y < 72; y += 6) {
      for (int x = 0; x < 96; x += 8) {
        const auto at = [&](int i, int j) { return static_cast<std::size_t>((y + j) * 96 + x + i); };
        const std::int16_t own = clean.labels[f].hard[at(0, 0)], now = c.labels[f].hard[at(0, 0)];
        if (own == kVoid) continue;
        for (int j = 0; j < 6; ++j) {
          for (int i = 0; i < 8; ++i) ASSERT_EQ(c.labels[f].hard[at(i, j)], now);
        }
        ++blocks;
        mistaken += now != own;
        if (now != own) taken_for[static_cast<std::size_t>(own)].insert(now);
      }
    }
  }
  EXPECT_NEAR(mistaken / static_cast<double>(blocks), 0.3, 0.05);  // a block is 0.7 % of the frame: chance 0.28
  for (const std::set<std::int16_t>& others : taken_for) EXPECT_EQ(others.size(), 2u);
}

TEST(SimulatedPredictions, BoundariesStrayButInteriorsStay) {
  Case c = scene_of(2);
  Labels label;
  for (int p = 0; p < 200 * 100; ++p) label.push_back(p % 200 < 100 ? 0 : 1);
  c.add(200, 100, label);
  c.apply(
      *step("simulated_predictions", "{output: hard, noise: 0, region_error: 0, overlap: 0, boundary_width: 0.02}"));
  int near = 0;
  for (int y = 0; y < 100; ++y) {
    for (int x = 0; x < 200; ++x) {
      const auto p = static_cast<std::size_t>(y * 200 + x);
      if (c.labels[0].hard[p] == label[p]) continue;
      ASSERT_LT(std::abs(x - 99.5), 6 * 4) << "six standard deviations of 4 pixels";
      ++near;
    }
  }
  EXPECT_GT(near, 50);
}

TEST(SimulatedPredictions, NoiseOfClassesAndFramesIsIndependentAndSmooth) {
  // One class of two everywhere: an error is where its noise falls short of the other's by the evidence. The difference
  // of two fields of deviation 2 exceeds 2 in under 24 % of the pixels (exactly that at the nodes, less between them).
  Case c = scene_of(2);
  for (int f = 0; f < 2; ++f) c.add(100, 80, Labels(8000, 0));
  c.scene.class_pixels[0][1] = 1;
  const StepFacts facts =
      c.apply(*step("simulated_predictions", "{output: hard, evidence: 2, noise: 2, region_error: 0, overlap: 0}"));
  const double right = std::stod(fact(facts, "pixel accuracy"));
  EXPECT_GT(right, 0.76);
  EXPECT_LT(right, 0.95);
  EXPECT_NE(c.labels[0].hard, c.labels[1].hard);
  int borders = 0;
  for (std::size_t p = 1; p < 8000; ++p) borders += c.labels[0].hard[p] != c.labels[0].hard[p - 1];
  EXPECT_LT(borders, 80 * 10) << "patches, not single pixels";
}

TEST(SimulatedPredictions, ErrorsGrowWithStrength) {
  double last = 1;
  for (const char* strength : {"0.5", "1", "2"}) {
    Case c = room();
    c.apply(*step("simulated_predictions", std::string("{strength: ") + strength + "}"));
    const double now = accuracy(room(), c);
    EXPECT_LT(now, last - 0.03) << strength;
    last = now;
  }
}

}  // namespace
}  // namespace semfield
