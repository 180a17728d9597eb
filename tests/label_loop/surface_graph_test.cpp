// Ways along the surface against Bellman and Ford's relaxation, seed by seed and within bounds; the pool of its points.
#include "surface/surface_graph.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

#include "compute/parallel.h"
#include "core/rng.h"
#include "tests/label_loop/seen_room.h"

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
    if (seed.class_index == cls) cost[seed.point] = 0;
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
      std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return cost[a][i] < cost[b][i]; });
      const Settled& found = graph.settled()[i];
      for (int slot = 0; slot < 2; ++slot) {
        const int cls = order[slot];
        const double expected = cost[cls][i];
        if (!std::isfinite(expected)) {
          EXPECT_EQ(found.cost[slot], kUnreached);
          EXPECT_EQ(found.class_index[slot], kVoid);
          ++unreached;
        } else {
          EXPECT_NEAR(found.cost[slot], expected, 1e-4 * (1 + expected)) << "point " << i;
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
      EXPECT_NEAR(all[k].cost, cost[at], 1e-4 * (1 + cost[at]));
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

// The surface that the views of the analytic room show, thinned to cells: points on it, as many as wanted, the same for
// any threads.

using namespace testing_loop;

TEST(SurfacePool, HasSomeAsManyPointsAsWanted) {
  const SeenRoom room;
  for (const std::int64_t wanted : {150, 400, 1000}) {
    const SurfacePool pool = make_surface_pool(room.views, room_limits(), wanted);
    EXPECT_GT(std::ssize(pool.points), wanted * 7 / 10);
    EXPECT_LT(std::ssize(pool.points), wanted * 14 / 10);
    EXPECT_EQ(pool.cells.count(), std::ssize(pool.points)) << "one point per cell";
  }
}

TEST(SurfacePool, PointsLieOnTheSurfaceThatTheirPixelsShow) {
  const SeenRoom room;
  const SurfacePool pool = make_surface_pool(room.views, room_limits(), 800);
  ASSERT_EQ(pool.point_of_pixel.size(), room.views.size());
  std::vector<std::size_t> pixels(pool.points.size(), 0);
  for (std::size_t v = 0; v < room.views.size(); ++v) {
    const SurfaceMap& map = room.views[v].map;
    ASSERT_EQ(pool.point_of_pixel[v].size(), map.distance_m.size());
    for (std::size_t i = 0; i < map.distance_m.size(); ++i) {
      const std::int32_t n = pool.point_of_pixel[v][i];
      ASSERT_GE(n, 0);
      const testkit::AnalyticHit hit =
          hit_at(room.views[v].camera, strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride));
      EXPECT_LT(length(hit.point - pool.points[n].position), std::sqrt(3.0) * pool.cell_m());
      ++pixels[n];
    }
  }
  std::size_t turned = 0, with_normal = 0;
  for (std::size_t i = 0; i < pool.points.size(); ++i) {
    const PoolPoint& point = pool.points[i];
    EXPECT_GT(pixels[i], 0u) << "a point that no pixel shows";
    EXPECT_EQ(pool.cells.near(point.position), static_cast<std::int32_t>(i)) << "a mean lies in its cell";
    const testkit::AnalyticHit hit = hit_at(room.views[point.view].camera, point.pixel);
    EXPECT_EQ(pool.cells.near(hit.point), static_cast<std::int32_t>(i)) << "its pixel shows its cell";
    for (int c = 0; c < 3; ++c) {
      EXPECT_GE(point.color[c], 0);
      EXPECT_LE(point.color[c], 1);
    }
    if (!point.interior) continue;
    ++with_normal;
    EXPECT_NEAR(length(point.normal), 1, 1e-9);
    if (dot(point.normal, hit.normal) > 0.9) ++turned;
  }
  EXPECT_GT(with_normal, pool.points.size() / 2);
  EXPECT_GT(turned, with_normal * 85 / 100) << "normals are the surface's, towards the cameras";
}

// Beside a step of depth no point is proposed: a click there may land on either side.
TEST(SurfacePool, BordersOfDepthAreNotInterior) {
  const SeenRoom room;
  const SurfacePool pool = make_surface_pool(room.views, room_limits(), 1000);
  int borders = 0;
  for (const PoolPoint& point : pool.points) {
    const PoolView& view = room.views[point.view];
    const std::int32_t x = point.pixel.column / view.map.stride, y = point.pixel.row / view.map.stride;
    const bool inside = x > 0 && y > 0 && x + 1 < view.map.width_px && y + 1 < view.map.height_px;
    if (!inside) {
      EXPECT_FALSE(point.interior);
      continue;
    }
    const auto depth = [&](std::int32_t dx, std::int32_t dy) {
      return static_cast<double>(view.map.distance_m[(y + dy) * view.map.width_px + x + dx]);
    };
    const double here = depth(0, 0);
    double step = 0;
    for (const auto& [dx, dy] : {std::pair{1, 0}, {0, 1}})
      step = std::max(step, std::abs(std::abs(depth(dx, dy) - here) - std::abs(here - depth(-dx, -dy))));
    if (step < 0.25 * here) continue;
    ++borders;
    EXPECT_FALSE(point.interior) << "view " << point.view << ", " << x << ", " << y;
  }
  const auto interior =
      std::count_if(pool.points.begin(), pool.points.end(), [](const PoolPoint& p) { return p.interior; });
  EXPECT_GT(interior, std::ssize(pool.points) / 2);
  EXPECT_LT(interior, std::ssize(pool.points));
  // The ball before the walls: in the maps themselves there are such borders.
  std::size_t beside = 0;
  for (const PoolView& view : room.views)
    for (std::size_t i = 1; i < view.map.distance_m.size(); ++i)
      if (std::abs(view.map.distance_m[i] - view.map.distance_m[i - 1]) > 0.25F * view.map.distance_m[i]) ++beside;
  EXPECT_GT(beside, 10u);
  RecordProperty("borders", borders);
}

TEST(SurfacePool, IsTheSameForAnyThreads) {
  const SeenRoom room;
  set_thread_count(1);
  const SurfacePool one = make_surface_pool(room.views, room_limits(), 500);
  set_thread_count(3);
  const SurfacePool three = make_surface_pool(room.views, room_limits(), 500);
  set_thread_count(0);
  EXPECT_EQ(one.cell_m(), three.cell_m());
  EXPECT_EQ(one.point_of_pixel, three.point_of_pixel);
  ASSERT_EQ(one.points.size(), three.points.size());
  for (std::size_t i = 0; i < one.points.size(); ++i) {
    EXPECT_EQ(one.points[i].position, three.points[i].position);
    EXPECT_EQ(one.points[i].normal, three.points[i].normal);
    EXPECT_EQ(one.points[i].pixel.column, three.points[i].pixel.column);
    EXPECT_EQ(one.points[i].view, three.points[i].view);
  }
}

TEST(SurfacePool, ViewsWithoutAMapOrASurfaceAddNothing) {
  SeenRoom room(2, 4);
  room.views[1].map = {};
  std::fill(room.views[2].map.distance_m.begin(), room.views[2].map.distance_m.end(), 0.0F);
  const SurfacePool pool = make_surface_pool(room.views, room_limits(), 300);
  EXPECT_TRUE(pool.point_of_pixel[1].empty());
  for (const std::int32_t n : pool.point_of_pixel[2]) EXPECT_EQ(n, -1);
  for (const PoolPoint& point : pool.points) EXPECT_TRUE(point.view == 0 || point.view == 3);
  for (PoolView& view : room.views) view.map = {};
  EXPECT_TRUE(make_surface_pool(room.views, room_limits(), 300).points.empty());
}

}  // namespace
}  // namespace semfield
