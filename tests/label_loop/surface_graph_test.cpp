// Ways along the surface: against Bellman and Ford's relaxation, seed by seed, in any order, and within bounds.
#include "surface/surface_graph.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <numeric>
#include <vector>

#include "core/rng.h"

namespace semfield {
namespace {

constexpr int kClasses = 4;

// Some cells of a slab of 12 x 12 x 3, with random colours, normals and places within them.
SurfacePool random_pool(std::uint64_t seed, double share = 0.6) {
  const RandomAddress random{seed, 0, stream_id("surface_graph_test")};
  std::uint64_t n = 0;
  const auto any = [&] { return static_cast<double>(uniform01(random, n++)); };
  SurfacePool pool;
  pool.cells = SurfaceCells(0.1);
  for (std::int32_t x = -6; x < 6; ++x) {
    for (std::int32_t y = -6; y < 6; ++y) {
      for (std::int32_t z = -1; z < 2; ++z) {
        if (any() > share) continue;
        PoolPoint point;
        pool.cells.add(SurfaceCell{x, y, z});
        point.position = Vec3d{x + any(), y + any(), z + any()} * pool.cell_m();
        point.normal = normalized(Vec3d{any() - 0.5, any() - 0.5, any() + 0.1});
        point.color = Vec3d{any(), any(), any()} * 0.3;
        point.interior = true;
        pool.points.push_back(point);
      }
    }
  }
  return pool;
}

// The rules' cost of a way between two cells that touch; infinite for others.
double way_cost(const SurfacePool& pool, std::size_t i, std::size_t j, const SurfaceGraphRules& rules) {
  const PoolPoint &a = pool.points[i], &b = pool.points[j];
  const auto at = [&](std::size_t n) { return pool.cells.place(static_cast<std::int32_t>(n)); };
  for (std::size_t axis = 0; axis < 3; ++axis)
    if (std::abs(at(i)[axis] - at(j)[axis]) > 1) return INFINITY;
  const double color = std::pow(length(a.color - b.color), 2);
  const double bend = std::pow(length(a.normal - b.normal), 2);
  return rules.way * length(a.position - b.position) / pool.cell_m() +
         std::min(rules.most, 0.5 * color / (rules.color_sigma * rules.color_sigma)) +
         std::min(rules.most, 0.5 * bend / (rules.normal_sigma * rules.normal_sigma));
}

// Cheapest ways from a class's seeds to every point, by relaxing every edge until nothing changes.
std::vector<double> relaxed(const SurfacePool& pool, const std::vector<GraphSeed>& seeds, int cls,
                            const SurfaceGraphRules& rules) {
  std::vector<double> cost(pool.points.size(), INFINITY);
  for (const GraphSeed& seed : seeds)
    if (seed.class_index == cls) cost[static_cast<std::size_t>(seed.point)] = 0;
  for (bool changed = true; changed;) {
    changed = false;
    for (std::size_t i = 0; i < cost.size(); ++i) {
      if (!std::isfinite(cost[i])) continue;
      for (std::size_t j = 0; j < cost.size(); ++j) {
        const double next = i == j ? INFINITY : cost[i] + way_cost(pool, i, j, rules);
        if (next >= cost[j] - 1e-12) continue;
        cost[j] = next;
        changed = true;
      }
    }
  }
  return cost;
}

std::vector<GraphSeed> random_seeds(const SurfacePool& pool, std::uint64_t seed, int count) {
  const RandomAddress random{seed, 1, stream_id("surface_graph_test")};
  std::map<std::int32_t, std::int16_t> chosen;  // one class a point: no ties
  for (int k = 0; std::ssize(chosen) < count; ++k)
    chosen.emplace(
        static_cast<std::int32_t>(uniform_below(random, static_cast<std::uint64_t>(2 * k), pool.points.size())),
        static_cast<std::int16_t>(uniform_below(random, static_cast<std::uint64_t>(2 * k + 1), kClasses)));
  std::vector<GraphSeed> seeds;
  for (const auto& [point, cls] : chosen) seeds.push_back({point, cls});
  return seeds;
}

void expect_same(const std::vector<Settled>& a, const std::vector<Settled>& b) {
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    for (int slot = 0; slot < 2; ++slot) {
      ASSERT_EQ(a[i].cost[slot], b[i].cost[slot]) << "point " << i;
      ASSERT_EQ(a[i].class_index[slot], b[i].class_index[slot]) << "point " << i;
    }
  }
}

TEST(SurfaceGraph, TheTwoCheapestClassesAreThoseOfABruteForce) {
  const SurfaceGraphRules rules;
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    SCOPED_TRACE(testing::Message() << "seed " << seed);
    const SurfacePool pool = random_pool(seed, seed == 4 ? 0.15 : 0.6);  // the last one falls apart
    SurfaceGraph graph(pool, rules);
    const std::vector<GraphSeed> seeds = random_seeds(pool, seed, 9);
    graph.settle(seeds);
    std::vector<std::vector<double>> cost;
    for (int cls = 0; cls < kClasses; ++cls) cost.push_back(relaxed(pool, seeds, cls, rules));
    int unreached = 0;
    for (std::size_t i = 0; i < pool.points.size(); ++i) {
      std::vector<int> order(kClasses);
      std::iota(order.begin(), order.end(), 0);
      std::stable_sort(order.begin(), order.end(), [&](int a, int b) {
        return cost[static_cast<std::size_t>(a)][i] < cost[static_cast<std::size_t>(b)][i];
      });
      const Settled& found = graph.settled()[i];
      for (int slot = 0; slot < 2; ++slot) {
        const int cls = order[static_cast<std::size_t>(slot)];
        const double expected = cost[static_cast<std::size_t>(cls)][i];
        if (!std::isfinite(expected)) {
          EXPECT_EQ(found.cost[slot], kUnreached);
          EXPECT_EQ(found.class_index[slot], kVoid);
          ++unreached;
        } else {
          EXPECT_NEAR(static_cast<double>(found.cost[slot]), expected, 1e-4 * (1 + expected)) << "point " << i;
          EXPECT_EQ(found.class_index[slot], cls) << "point " << i;
        }
      }
    }
    EXPECT_EQ(unreached > 0, seed == 4);
  }
}

TEST(SurfaceGraph, SeedsMayComeOneByOneInAnyOrder) {
  const SurfacePool pool = random_pool(11);
  SurfaceGraph whole(pool, {}), single(pool, {});
  std::vector<GraphSeed> seeds = random_seeds(pool, 11, 12);
  whole.settle(seeds);
  const std::vector<Settled> expected = whole.settled();
  for (int order = 0; order < 8; ++order) {
    SCOPED_TRACE(testing::Message() << "order " << order);
    std::rotate(seeds.begin(), seeds.begin() + 1 + order % 3, seeds.end());
    if (order % 2 == 1) std::reverse(seeds.begin(), seeds.end());
    whole.settle(seeds);
    expect_same(whole.settled(), expected);
    single.settle({});
    for (const GraphSeed& seed : seeds) single.add(seed);
    for (const GraphSeed& seed : seeds) single.add(seed);  // twice is as good as once
    expect_same(single.settled(), expected);
  }
  single.settle({});
  for (const Settled& s : single.settled()) {
    EXPECT_EQ(s.cost[0], kUnreached);
    EXPECT_EQ(s.class_index[0], kVoid);
  }
  single.add({-1, 1});  // a place that lies on no point
  EXPECT_EQ(single.settled()[0].class_index[0], kVoid);
}

TEST(SurfaceGraph, AroundIsTheCheapestWithinReachInOrder) {
  const SurfacePool pool = random_pool(5);
  const SurfaceGraph graph(pool, {});
  SurfaceGraph::Scratch scratch;
  std::vector<SurfaceGraph::Near> all, some;
  for (const std::int32_t from : {0, 40, 101}) {
    const std::vector<double> cost = relaxed(pool, {{from, 0}}, 0, {});
    const float reach = 9;
    graph.around(from, reach, pool.points.size(), scratch, all);
    ASSERT_FALSE(all.empty());
    EXPECT_EQ(all[0].point, from);
    EXPECT_EQ(all[0].cost, 0);
    std::vector<bool> met(pool.points.size(), false);
    for (std::size_t k = 0; k < all.size(); ++k) {
      const auto at = static_cast<std::size_t>(all[k].point);
      EXPECT_FALSE(met[at]);
      met[at] = true;
      EXPECT_LE(all[k].cost, reach);
      EXPECT_NEAR(static_cast<double>(all[k].cost), cost[at], 1e-4 * (1 + cost[at]));
      EXPECT_GE(all[k].cost, all[k > 0 ? k - 1 : 0].cost);
    }
    for (std::size_t i = 0; i < cost.size(); ++i) {
      if (std::abs(cost[i] - static_cast<double>(reach)) < 1e-3) continue;
      EXPECT_EQ(met[i], cost[i] < static_cast<double>(reach)) << "point " << i;
    }
    ASSERT_GT(all.size(), 5u);
    graph.around(from, reach, 5, scratch, some);  // the same memory again
    ASSERT_EQ(some.size(), 5u);
    for (std::size_t k = 0; k < 5; ++k) EXPECT_EQ(some[k].cost, all[k].cost);
    graph.around(from, 0, 5, scratch, some);
    EXPECT_EQ(some.size(), 1u);
  }
}

// A row of cells along x: the way over the middle costs what lies there.
SurfacePool row_of_cells() {
  SurfacePool pool;
  pool.cells = SurfaceCells(1);
  for (std::int32_t x = 0; x < 9; ++x) {
    PoolPoint point;
    pool.cells.add(SurfaceCell{x, 0, 0});
    point.position = {x + 0.5, 0.5, 0.5};
    point.normal = {0, 0, 1};
    pool.points.push_back(point);
  }
  return pool;
}

float cost_across(const SurfacePool& pool) {
  SurfaceGraph graph(pool, {});
  graph.add({0, 0});
  return graph.settled()[8].cost[0];
}

TEST(SurfaceGraph, WaysAreDearerAcrossStepsOfColourAndBends) {
  const SurfacePool plain = row_of_cells();
  const float way = cost_across(plain);
  EXPECT_NEAR(way, 8 * SurfaceGraphRules().way, 1e-5);
  float before = way;
  for (const float step : {0.1F, 0.2F, 0.3F}) {
    SurfacePool painted = plain;
    for (std::size_t i = 4; i < 9; ++i) painted.points[i].color.y = static_cast<double>(step);
    const float cost = cost_across(painted);
    EXPECT_NEAR(cost - way, 50 * step * step, 1e-3) << "a step of a sigma costs 1/2";
    EXPECT_GT(cost, before);
    before = cost;
  }
  before = way;
  for (const double angle : {0.2, 0.5, 1.0}) {
    SurfacePool bent = plain;
    for (std::size_t i = 4; i < 9; ++i) bent.points[i].normal = {std::sin(angle), 0, std::cos(angle)};
    const float cost = cost_across(bent);
    EXPECT_GT(cost, before + 0.1F);
    before = cost;
  }
  SurfacePool wall = plain;  // black beside white, and back to back: each of the two has its most
  for (std::size_t i = 4; i < 9; ++i) {
    wall.points[i].color = {1, 1, 1};
    wall.points[i].normal = {0, 0, -1};
  }
  EXPECT_NEAR(cost_across(wall), way + 2 * SurfaceGraphRules().most, 1e-4);
}

TEST(SurfaceGraph, APlaceIsThatOfItsCellOrOfOneBesideIt) {
  const SurfacePool pool = row_of_cells();
  const SurfaceCells& cells = pool.cells;
  EXPECT_EQ(cells.near({3.9, 0.1, 0.9}), 3);
  EXPECT_EQ(cells.near({3.9, 1.2, 0.5}), 3) << "one cell above";
  EXPECT_EQ(cells.near({9.4, 0.5, 0.5}), 8) << "one cell behind the last";
  EXPECT_EQ(cells.near({3.5, 2.5, 0.5}), -1);
  EXPECT_EQ(cells.near({1e300, -1e300, 0}), -1);
  EXPECT_EQ(SurfaceCells().near({0, 0, 0}), -1);
}

}  // namespace
}  // namespace semfield
