// Products and means of class probabilities against numbers worked out by hand.
#include "surface/fuse/class_votes.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "classes/class_table.h"
#include "core/error.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using Row = std::array<double, 3>;

ClassVotes three(double floor = 1e-6, double confidence = 0.8) { return {3, floor, HardLikelihood(confidence, 3)}; }

TEST(ClassVotes, BayesianIsTheProduct) {
  ClassVotes votes = three();
  votes.add(Row{0.5, 0.3, 0.2});
  votes.add(Row{0.1, 0.6, 0.3});
  // 0.05, 0.18, 0.06 of 0.29.
  Row p{};
  votes.bayesian(p);
  EXPECT_NEAR(p[0], 5.0 / 29, 1e-14);
  EXPECT_NEAR(p[1], 18.0 / 29, 1e-14);
  EXPECT_NEAR(p[2], 6.0 / 29, 1e-14);
  EXPECT_EQ(votes.bayesian_label(kVoid), 1);
  EXPECT_EQ(votes.views(), 2);
}

TEST(ClassVotes, AverageIsTheMean) {
  ClassVotes votes = three();
  votes.add(Row{0.5, 0.3, 0.2});
  votes.add(Row{0.1, 0.6, 0.3});
  votes.add(Row{0.9, 0.0, 0.0});  // a tenth belongs to no class
  Row p{};
  votes.average(p);
  EXPECT_NEAR(p[0], 0.5, 1e-15);
  EXPECT_NEAR(p[1], 0.3, 1e-15);
  EXPECT_NEAR(p[2], 0.5 / 3, 1e-15);
  EXPECT_EQ(votes.average_label(kVoid), 0);
}

TEST(ClassVotes, ProductAndMeanDisagreeWhereOneViewIsSure) {
  // Two hesitant views for class 0, one sure one for class 1: 0.6 * 0.6 * 0.01 = 0.0036 against 0.4 * 0.4 * 0.98.
  ClassVotes votes = three();
  votes.add(Row{0.6, 0.4, 0});
  votes.add(Row{0.6, 0.4, 0});
  votes.add(Row{0.01, 0.98, 0.01});
  EXPECT_EQ(votes.bayesian_label(kVoid), 1);
  Row p{};
  votes.average(p);
  EXPECT_NEAR(p[0], 1.21 / 3, 1e-15);
  EXPECT_NEAR(p[1], 1.78 / 3, 1e-15);
}

TEST(ClassVotes, FloorKeepsOneViewFromRulingOutAClass) {
  // Nine views give class 0 0.9; one gives it nothing. With a floor of 1e-3: 0.9^9 * 1e-3 = 3.9e-4 against
  // 0.1^9 * 1 = 1e-9. With 1e-12 the one view wins: 3.9e-13 < 1e-9.
  for (const auto& [floor, label] : {std::pair{1e-3, 0}, std::pair{1e-12, 1}}) {
    ClassVotes votes = three(floor);
    for (int i = 0; i < 9; ++i) votes.add(Row{0.9, 0.1, 0});
    votes.add(Row{0, 1, 0});
    EXPECT_EQ(votes.bayesian_label(kVoid), label) << floor;
    Row p{};
    votes.bayesian(p);
    const double zero = std::pow(0.9, 9) * floor, one = std::pow(0.1, 9);
    const double two = std::pow(floor, 10);
    EXPECT_NEAR(p[0], zero / (zero + one + two), 1e-12);
    EXPECT_EQ(votes.average_label(kVoid), 0);
  }
}

TEST(ClassVotes, LabelsBecomeAConfusionLikelihood) {
  ClassVotes votes = three(1e-6, 0.8);
  votes.add(std::int16_t{2});
  votes.add(Row{0.5, 0.3, 0.2});
  // 0.1 * 0.5, 0.1 * 0.3, 0.8 * 0.2 of 0.24.
  Row p{};
  votes.bayesian(p);
  EXPECT_NEAR(p[0], 5.0 / 24, 1e-14);
  EXPECT_NEAR(p[1], 3.0 / 24, 1e-14);
  EXPECT_NEAR(p[2], 16.0 / 24, 1e-14);
  votes.average(p);
  EXPECT_NEAR(p[0], 0.3, 1e-15);
  EXPECT_NEAR(p[1], 0.2, 1e-15);
  EXPECT_NEAR(p[2], 0.5, 1e-15);
}

TEST(ClassVotes, ManyViewsNeitherOverflowNorVanish) {
  ClassVotes votes = three();
  for (int i = 0; i < 100000; ++i) votes.add(Row{0.4, 0.35, 0.25});
  Row p{};
  votes.bayesian(p);
  EXPECT_DOUBLE_EQ(p[0], 1);
  EXPECT_DOUBLE_EQ(p[0] + p[1] + p[2], 1);
}

TEST(ClassVotes, EqualVotesGoToThePreferredLabelThenTheFirst) {
  ClassVotes votes = three();
  votes.add(std::int16_t{2});
  votes.add(std::int16_t{1});
  EXPECT_EQ(votes.bayesian_label(2), 2);
  EXPECT_EQ(votes.average_label(2), 2);
  EXPECT_EQ(votes.bayesian_label(1), 1);
  EXPECT_EQ(votes.bayesian_label(0), 1);  // not among the best
  EXPECT_EQ(votes.average_label(kVoid), 1);
  votes.add(std::int16_t{1});
  EXPECT_EQ(votes.bayesian_label(2), 1);
}

TEST(ClassVotes, NothingAddedIsVoid) {
  ClassVotes votes = three();
  votes.add(std::int16_t{2});
  votes.clear();
  EXPECT_EQ(votes.bayesian_label(0), kVoid);
  EXPECT_EQ(votes.average_label(0), kVoid);
  Row p{1, 1, 1};
  votes.bayesian(p);
  EXPECT_EQ(p, Row{});
  votes.average(p);
  EXPECT_EQ(p, Row{});
}

TEST(ClassVotes, AConfidenceThatSaysNothingIsRefused) {
  EXPECT_EQ(testing_room::error_of([] { HardLikelihood(0.25, 4); }),
            "fuse.hard_confidence: 0.25 says nothing among 4 classes, each has 0.25; write more than 0.25");
  EXPECT_DOUBLE_EQ(HardLikelihood(0.7, 4).miss, 0.1);
  EXPECT_DOUBLE_EQ(HardLikelihood(0.3, 1).hit, 0.3);
}

}  // namespace
}  // namespace semfield
