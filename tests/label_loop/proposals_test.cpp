// Which click is proposed next, what each way of choosing says of itself, and how clicks calibrate confidence.
#include <gtest/gtest.h>

#include <algorithm>

#include "compute/parallel.h"
#include "serve/point_learner.h"
#include "tests/label_loop/seen_room.h"

namespace semfield {
namespace {

using namespace testing_loop;

// The room's surface, and what is known of it.
struct Known {
  SeenRoom room;
  SurfacePool pool = make_surface_pool(room.views, room_limits(), 600);
  SurfaceGraph graph{pool, {}};
  std::vector<float> probability;
  std::vector<Vec3d> answered;
  std::vector<std::int32_t> passed;

  ProposalInput input(std::uint64_t seed = 1, std::uint64_t round = 0) const {
    return ProposalInput{.pool = &pool,
                         .graph = &graph,
                         .probability = probability,
                         .classes = 3,
                         .answered = answered,
                         .passed = passed,
                         .seed = seed,
                         .round = round};
  }
  // Rows of two probabilities that are alike but at `point`.
  void doubt_only(std::size_t point) {
    probability.clear();
    for (std::size_t i = 0; i < pool.points.size(); ++i) {
      const float sure = i == point ? 0.5F : 0.97F;
      probability.insert(probability.end(), {sure, 1 - sure, 0.0F});
    }
  }
  std::int32_t click(std::int16_t cls, std::int32_t point) {
    graph.add({point, cls});
    answered.push_back(pool.points[point].position);
    return point;
  }
};

constexpr Acquisition kAll[] = {Acquisition::random, Acquisition::farthest, Acquisition::entropy, Acquisition::margin,
                                Acquisition::surface};

TEST(Proposals, BarredPointsAreNotAskedAbout) {
  Known known;
  std::vector<bool> barred(known.pool.points.size(), true);
  for (std::size_t i = 0; i < barred.size(); ++i) barred[i] = known.pool.points[i].position.x > 0;
  for (std::uint64_t round = 0; round < 20; ++round) {
    ProposalInput input = known.input(1, round);
    input.barred = &barred;
    const auto asked = choose_click(Acquisition::surface, input);
    ASSERT_TRUE(asked.has_value());
    EXPECT_FALSE(barred[asked->point]) << round;
  }
}

TEST(Proposals, NothingIsAskedOfAnEmptyPool) {
  const SurfacePool none;
  const SurfaceGraph graph(none, {});
  ProposalInput in{.pool = &none, .graph = &graph};
  for (const Acquisition how : kAll) EXPECT_FALSE(choose_click(how, in).has_value());
}

TEST(Proposals, BeforeTheFirstClickAnythingIsUnseen) {
  const Known known;
  for (const Acquisition how : kAll) {
    const std::optional<Asked> asked = choose_click(how, known.input());
    ASSERT_TRUE(asked.has_value());
    EXPECT_GE(asked->point, 0);
    EXPECT_LT(asked->point, std::ssize(known.pool.points));
    EXPECT_EQ(asked->why, "unseen");
  }
}

TEST(Proposals, EachWayOfChoosingDoesWhatItSays) {
  Known known;
  const std::size_t odd = known.pool.points.size() / 3;
  known.doubt_only(odd);
  EXPECT_EQ(choose_click(Acquisition::entropy, known.input())->point, static_cast<std::int32_t>(odd));
  EXPECT_EQ(choose_click(Acquisition::margin, known.input())->point, static_cast<std::int32_t>(odd));
  // The margin looks at two classes alone, entropy at all of them.
  const std::size_t torn = 7, spread = 11;
  for (std::size_t i = 0; i < known.pool.points.size(); ++i)
    for (std::size_t c = 0; c < 3; ++c) known.probability[3 * i + c] = c == 0 ? 0.9F : 0.05F;
  for (std::size_t c = 0; c < 3; ++c) {
    known.probability[3 * torn + c] = c < 2 ? 0.5F : 0.0F;
    known.probability[3 * spread + c] = c == 0 ? 0.4F : 0.3F;
  }
  EXPECT_EQ(choose_click(Acquisition::margin, known.input())->point, static_cast<std::int32_t>(torn));
  EXPECT_EQ(choose_click(Acquisition::entropy, known.input())->point, static_cast<std::int32_t>(spread));

  known.click(0, 0);
  known.click(0, 5);
  const std::int32_t far = choose_click(Acquisition::farthest, known.input())->point;
  const auto nearest = [&](std::size_t i) {
    double least = INFINITY;
    for (const Vec3d& place : known.answered) least = std::min(least, length(known.pool.points[i].position - place));
    return least;
  };
  for (std::size_t i = 0; i < known.pool.points.size(); ++i)
    EXPECT_LE(nearest(i), nearest(static_cast<std::size_t>(far)));
  // Random pixels: not one of them alone.
  std::vector<std::int32_t> drawn;
  for (std::uint64_t round = 0; round < 20; ++round)
    drawn.push_back(choose_click(Acquisition::random, known.input(1, round))->point);
  std::sort(drawn.begin(), drawn.end());
  EXPECT_GT(std::unique(drawn.begin(), drawn.end()) - drawn.begin(), 15);
}

TEST(Proposals, TheSameSeedAndRoundAskTheSameForAnyThreads) {
  Known known;
  known.click(0, 3);
  known.doubt_only(20);
  std::vector<std::int32_t> asked;
  for (std::uint64_t round = 0; round < 6; ++round) {
    for (const Acquisition how : kAll) {
      set_thread_count(1);
      const Asked one = *choose_click(how, known.input(9, round));
      set_thread_count(3);
      const Asked three = *choose_click(how, known.input(9, round));
      set_thread_count(0);
      EXPECT_EQ(one.point, three.point);
      EXPECT_EQ(one.gain, three.gain);
      if (how == Acquisition::surface) asked.push_back(one.point);
    }
  }
}

// One class is named at one place: what is far from it by way of the surface is proposed, however sure the network is.
TEST(Proposals, WithOneClassTheOpenSurfaceIsAskedFor) {
  Known known;
  const std::int32_t clicked = known.click(0, 10);
  for (std::size_t i = 0; i < known.pool.points.size(); ++i)
    known.probability.insert(known.probability.end(), {1.0F, 0.0F, 0.0F});
  for (std::uint64_t round = 0; round < 10; ++round) {
    const Asked asked = *choose_click(Acquisition::surface, known.input(2, round));
    EXPECT_NE(asked.point, clicked);
    EXPECT_TRUE(known.pool.points[asked.point].interior);
    EXPECT_GT(asked.gain, 0);
    const float way = known.graph.settled()[asked.point].cost[0];
    EXPECT_GT(way, ProposalRules().reach);
    EXPECT_EQ(asked.why, way >= ProposalRules().unseen ? "unseen" : "uncertain");
  }
}

TEST(Proposals, WhatWasPassedOverIsNotAskedAgain) {
  Known known;
  known.click(0, 0);
  SurfaceGraph::Scratch scratch;
  std::vector<SurfaceGraph::Near> near;
  for (int turn = 0; turn < 12; ++turn) {
    const Asked asked = *choose_click(Acquisition::surface, known.input(4, static_cast<std::uint64_t>(turn)));
    for (const std::int32_t point : known.passed) {
      known.graph.around(point, ProposalRules().reach, ProposalRules().most, scratch, near);
      for (const SurfaceGraph::Near& n : near) EXPECT_NE(n.point, asked.point) << "beside what was passed over";
    }
    known.passed.push_back(asked.point);
  }
}

// The temperature by clicks that were held back: which may be, what a few wrong ones do, and what settles nothing.

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
