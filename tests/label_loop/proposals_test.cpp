// Which click is asked for next: what each way of choosing says of itself.
#include "serve/proposals.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "compute/parallel.h"
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
    ProposalInput in;
    in.pool = &pool;
    in.graph = &graph;
    in.probability = probability;
    in.classes = 3;
    in.answered = answered;
    in.passed = passed;
    in.seed = seed;
    in.round = round;
    return in;
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
    answered.push_back(pool.points[static_cast<std::size_t>(point)].position);
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
    EXPECT_FALSE(barred[static_cast<std::size_t>(asked->point)]) << round;
  }
}

TEST(Proposals, NothingIsAskedOfAnEmptyPool) {
  const SurfacePool none;
  const SurfaceGraph graph(none, {});
  ProposalInput in;
  in.pool = &none;
  in.graph = &graph;
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

// One class is named at one place: what is far from it by way of the surface is asked for, however sure the network is.
TEST(Proposals, WithOneClassTheOpenSurfaceIsAskedFor) {
  Known known;
  const std::int32_t clicked = known.click(0, 10);
  for (std::size_t i = 0; i < known.pool.points.size(); ++i)
    known.probability.insert(known.probability.end(), {1.0F, 0.0F, 0.0F});
  for (std::uint64_t round = 0; round < 10; ++round) {
    const Asked asked = *choose_click(Acquisition::surface, known.input(2, round));
    EXPECT_NE(asked.point, clicked);
    EXPECT_TRUE(known.pool.points[static_cast<std::size_t>(asked.point)].interior);
    EXPECT_GT(asked.gain, 0);
    const float way = known.graph.settled()[static_cast<std::size_t>(asked.point)].cost[0];
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

}  // namespace
}  // namespace semfield
