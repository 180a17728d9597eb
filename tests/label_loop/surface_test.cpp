// Ways along the surface against Bellman and Ford's relaxation, seed by seed and within bounds; the pool of its points.

#include <algorithm>
#include <numeric>
#include <tuple>

#include "core/rng.h"
#include "labels/mask_outlines.h"
#include "labels/serve/view_pictures.h"
#include "tests/label_loop/labelled_room.h"
#include "tests/threads.h"

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

TEST(SurfaceGraph, SegmentsPartWhatLooksAlikeAndJoinWhatDoesNot) {
  SurfacePool pool = row_of_cells();
  const float way = cost_across(pool);
  const SurfaceGraphRules rules;
  const std::uint64_t key = std::uint64_t{3} << 32 | 4;
  pool.segment_steps[key] = {.within = 1, .across = 3};
  EXPECT_NEAR(cost_across(pool), way + 0.75 * rules.segment_border, 1e-5);
  for (std::size_t i = 4; i < 9; ++i) pool.points[i].color.y = 0.2;  // costs 2
  EXPECT_NEAR(cost_across(pool), way + 0.75 * rules.segment_border + 2 * (0.75 + 0.25 * rules.within_segment), 1e-4);
  pool.segment_steps[key] = {.within = 5, .across = 0};
  EXPECT_NEAR(cost_across(pool), way + 2 * rules.within_segment, 1e-4);
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

// Of one view the right half is another segment: steps across lie on that line alone, each between two pixels.
TEST(SurfacePool, CountsWhatSegmentsSayOfNeighbours) {
  SeenRoom room;
  const StoredFrame& photo = *room.views[0].photo;
  FrameSegments halves{photo.width_px, photo.height_px, {}, {}};
  for (std::int32_t y = 0; y < photo.height_px; ++y)
    for (std::int32_t x = 0; x < photo.width_px; ++x) halves.id.push_back(2 * x < photo.width_px ? 5 : 9);
  room.views[0].segments = &halves;
  const SurfacePool pool = make_surface_pool(room.views, room_limits(), 1000);
  const SurfaceMap& map = room.views[0].map;
  std::int64_t within = 0, across = 0, expected_within = 0, expected_across = 0;
  for (const auto& [key, steps] : pool.segment_steps) {
    EXPECT_LT(key >> 32, key & 0xFFFFFFFF);
    within += steps.within;
    across += steps.across;
  }
  for (std::int32_t y = 0; y < map.height_px; ++y) {
    for (std::int32_t x = 0; x < map.width_px; ++x) {
      const auto point = [&](std::int32_t u, std::int32_t v) { return pool.point_of_pixel[0][v * map.width_px + u]; };
      const auto right = [&](std::int32_t u) { return 2 * (u * map.stride + map.stride / 2) >= photo.width_px; };
      if (x + 1 < map.width_px && point(x, y) != point(x + 1, y))
        ++(right(x) == right(x + 1) ? expected_within : expected_across);
      if (y + 1 < map.height_px && point(x, y) != point(x, y + 1)) ++expected_within;
    }
  }
  EXPECT_GT(across, map.height_px / 2);
  EXPECT_EQ(across, expected_across);
  EXPECT_EQ(within, expected_within);
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

// Distances along the rays of a camera, near the truth once a room is learned, and what a view sees of the surface.

using namespace testing_train;

const std::string kDepth = "losses: [{type: depth, kind: line_of_sight, weight: 0.3, from_step: 0}]\n";

struct LearnedRoom : testing::Test {
  static void SetUpTestSuite() {
    session_ = new Session(open_text(hash_config(kDepth)));
    Trainer trainer(*session_);
    while (trainer.step() < 200) trainer.advance();
  }
  static void TearDownTestSuite() { delete session_; }
  static RayCamera camera(std::size_t frame) {
    const FrameInfo& info = session_->scene.info.frames[frame];
    return {info.camera, info.world_from_camera, session_->plan.undistortion};
  }
  static SurfaceMap map_of(std::size_t frame, std::int32_t stride) {
    return make_surface_map(*session_->pipeline, camera(frame), session_->limits, stride, 200);
  }
  static Session* session_;
};
Session* LearnedRoom::session_ = nullptr;

TEST_F(LearnedRoom, DistancesAreNearTheTruth) {
  const double cell = 4.0 / 64;  // of the finest level, and of the occupancy grid 4 / 32
  for (const std::size_t frame : {0, 3, 5}) {
    const SurfaceMap map = map_of(frame, 2);
    EXPECT_EQ(map.width_px, 24);
    EXPECT_EQ(map.height_px, 18);
    EXPECT_EQ(map.step, 200);
    std::vector<double> wrong;
    for (std::int64_t i = 0; i < std::ssize(map.distance_m); ++i) {
      const PixelPlace pixel = strided_place(i, map.width_px, map.stride);
      const double found = static_cast<double>(map.distance_m[i]);
      if (!(found > 0)) continue;
      double o[3], d[3], near_far[2];
      cast_ray(camera(frame), session_->limits, pixel.column, pixel.row, o, d, near_far);
      const testkit::AnalyticHit hit = testkit::intersect_analytic_room({o[0], o[1], o[2]}, {d[0], d[1], d[2]});
      wrong.push_back(std::abs(found - hit.t_m));
      const Vec3d place = point_at(camera(frame), session_->limits, pixel, found);
      EXPECT_NEAR(length(place - hit.point), wrong.back(), 1e-6);
    }
    EXPECT_GT(wrong.size(), map.distance_m.size() * 9 / 10);
    std::sort(wrong.begin(), wrong.end());
    EXPECT_LT(wrong[wrong.size() / 2], 2 * cell) << "frame " << frame;
  }
}

// Expected distance over opacity as rendering has them, and nothing where opacity is low.
TEST_F(LearnedRoom, TheyAreThoseOfRendering) {
  const RayCamera from = camera(1);
  std::vector<PixelPlace> pixels;
  std::vector<double> origin, direction, near_far;
  for (std::int32_t y = 0; y < from.camera.height_px; y += 5) {
    for (std::int32_t x = 0; x < from.camera.width_px; x += 3) {
      double o[3], d[3], nf[2];
      cast_ray(from, session_->limits, x, y, o, d, nf);
      pixels.push_back({x, y});
      origin.insert(origin.end(), o, o + 3);
      direction.insert(direction.end(), d, d + 3);
      near_far.insert(near_far.end(), nf, nf + 2);
    }
  }
  const std::int64_t count = std::ssize(pixels);
  std::vector<float> depth(pixels.size()), opacity(pixels.size());
  RenderJob<float> job{.origin = {origin.data(), count, 3},
                       .direction = {direction.data(), count, 3},
                       .near_far = {near_far.data(), count, 2},
                       .depth = {depth.data(), count, 1},
                       .opacity = {opacity.data(), count, 1}};
  session_->pipeline->executor().render(job);
  const std::vector<float> found = surface_distances(*session_->pipeline, from, session_->limits, pixels);
  for (std::size_t i = 0; i < pixels.size(); ++i)
    EXPECT_EQ(found[i], opacity[i] < kSurfaceOpacity ? 0 : depth[i] / opacity[i]);
  EXPECT_TRUE(surface_distances(*session_->pipeline, from, session_->limits, {}).empty());
  // An empty ray: nothing is met behind the far limit.
  RayLimits none = session_->limits;
  none.near_m = 9;
  none.far_m = 9.5;
  for (const float nothing : surface_distances(*session_->pipeline, from, none, pixels)) EXPECT_EQ(nothing, 0);
}

TEST_F(LearnedRoom, AMapIsTheSameOfAnyStride) {
  const SurfaceMap one = map_of(2, 3), every = map_of(2, 1);
  ASSERT_EQ(every.distance_m.size(), 48u * 36u);
  for (std::int64_t i = 0; i < std::ssize(one.distance_m); ++i) {
    const PixelPlace at = strided_place(i, one.width_px, one.stride);
    EXPECT_EQ(one.distance_m[i], every.at(at.column, at.row));
    EXPECT_EQ(one.at(at.column, at.row), every.at(at.column, at.row));
  }
  EXPECT_EQ(one.at(47, 35), one.distance_m.back());
  EXPECT_EQ(map_of(2, 1000).distance_m.size(), 1u) << "no stride is longer than the shorter side";
  EXPECT_TRUE(SurfaceMap().empty());
}

// Places of the surface as cameras see them: the inverse of a ray, what is hidden, clicks of other views.

constexpr double kTolerance_m = 0.05;

Vec3d place_at(const RayCamera& camera, const PixelPlace& pixel) {
  return point_at(camera, room_limits(), pixel, hit_at(camera, pixel).t_m);
}

Annotations::Mark mark(const std::string& id, int frame, std::vector<PixelPoint> points) {
  return {id, frame, std::move(points), 0, 0};
}

TEST(SurfaceSight, AProjectionIsTheInverseOfARay) {
  SeenRoom room;
  RayCamera camera = room.views[0].camera;
  for (const bool has_lens : {false, true}) {
    camera.undistort = has_lens;
    if (has_lens) {
      camera.camera.k1 = -0.12;
      camera.camera.p1 = 0.003;
    }
    for (std::int32_t row = 1; row < camera.camera.height_px; row += 7) {
      for (std::int32_t column = 1; column < camera.camera.width_px; column += 7) {
        const auto at = pixel_of(camera, point_at(camera, room_limits(), {column, row}, 1.7));
        ASSERT_TRUE(at.has_value()) << column << ", " << row;
        EXPECT_NEAR(at->x, column + 0.5, 1e-6);
        EXPECT_NEAR(at->y, row + 0.5, 1e-6);
      }
    }
  }
  EXPECT_FALSE(pixel_of(camera, camera.world_from_camera.t - camera.world_from_camera.axis(2)).has_value())
      << "behind the camera";
  EXPECT_FALSE(pixel_of(camera, camera.world_from_camera.apply({50, 0, 1})).has_value()) << "far off the axis";
}

TEST(SurfaceSight, AClickIsSeenInOtherViewsWhereNothingHidesIt) {
  SeenRoom room(1);
  std::vector<Annotations::Mark> marks;
  for (int k = 0; k < 40; ++k)
    marks.push_back(mark("m" + std::to_string(k), k % 2, {{(17 * k + 5) % 44 + 2.5, (11 * k + 7) % 32 + 2.5}}));
  int seen = 0, hidden = 0;
  for (int v = 1; v < std::ssize(room.views); ++v) {
    const PoolView& view = room.views[v];
    const std::vector<SeenMark> found = marks_seen(marks, view.map, v, room.views, room_limits(), kTolerance_m);
    for (const Annotations::Mark& m : marks) {
      const auto own = std::find_if(found.begin(), found.end(), [&](const SeenMark& s) { return s.id == m.id; });
      if (m.frame == v) {
        EXPECT_EQ(own, found.end()) << "a view's own click";
        continue;
      }
      const PixelPlace from{static_cast<std::int32_t>(m.points[0].x), static_cast<std::int32_t>(m.points[0].y)};
      const Vec3d place = place_at(room.views[m.frame].camera, from);
      const auto at = pixel_of(view.camera, place);
      const double before =
          at ? length(place_at(view.camera, {static_cast<std::int32_t>(at->x), static_cast<std::int32_t>(at->y)}) -
                      place)
             : 1e9;
      if (own != found.end()) {
        ++seen;
        EXPECT_EQ(own->points.size(), 1u);
        EXPECT_LT(before, 0.35) << m.id << " is shown on something else in view " << v;
      } else if (before > 0.35) {
        ++hidden;
      } else {
        EXPECT_GT(before, 0.02) << m.id << " is not shown in view " << v;
      }
    }
  }
  EXPECT_GT(seen, 20);
  EXPECT_GT(hidden, 5);
}

TEST(SurfaceSight, PlacesFollowMapsAndMarks) {
  SeenRoom room(1);
  const PoolView& view = room.views[1];
  std::vector<Annotations::Mark> marks;
  const auto seen = [&] { return marks_seen(marks, view.map, 1, room.views, room_limits(), kTolerance_m); };
  for (double x = 2.5; x < 46; x += 4) marks.push_back(mark("x" + std::to_string(x), 0, {{x, 20.5}}));
  const std::size_t first = seen().size();
  ASSERT_GT(first, 0u);
  for (float& way : room.views[0].map.distance_m) way *= 0.4F;  // the geometry is another
  room.views[0].map.step = 7;
  EXPECT_LT(seen().size(), first);
  for (Annotations::Mark& m : marks) m.class_index = kVoid;  // what is ignored is so in its own view
  EXPECT_TRUE(seen().empty());
  room.views[0].map = {};
  marks[0].class_index = 0;
  EXPECT_TRUE(seen().empty()) << "a view without a map";
}

// Places of clicks and strokes in the pool, the pixels that they mark, and coarse labels brought to a photograph.

// Every pixel of a view.
LabelledPixels whole_view(int view, std::int16_t class_index = 0) {
  LabelledPixels stroke{view, class_index, {}};
  for (std::int32_t i = 0; i < 48 * 36; ++i) stroke.pixels.push_back({i % 48, i / 48});
  return stroke;
}

TEST(Places, AStrokeHasOnePlaceInEachCellThatItCovers) {
  LoopedRoom room(60);
  LabelLoop& loop = *room.loop;
  const std::vector<LabelledPixels> strokes{whole_view(2)};
  ASSERT_TRUE(loop.find_places(strokes, 1e9));
  std::set<std::int32_t> seen(loop.pool().point_of_pixel[2].begin(), loop.pool().point_of_pixel[2].end());
  seen.erase(-1);
  const auto nothing = static_cast<std::size_t>(
      std::count(loop.pool().point_of_pixel[2].begin(), loop.pool().point_of_pixel[2].end(), -1));
  EXPECT_GT(loop.places_of(0).size(), seen.size() / 2);
  EXPECT_LE(loop.places_of(0).size(), std::min<std::size_t>(256, seen.size() + nothing));
}

TEST(Places, AClickHasItsOwnPlaceFirst) {
  LoopedRoom room(60);
  LabelLoop& loop = *room.loop;
  const LabelledPixels click = room.click(1, {20, 18});
  const std::vector<LabelledPixels> clicks{click};
  ASSERT_TRUE(loop.find_places(clicks, 1e9));
  const RayCamera& camera = loop.view(1).camera;
  const RayLimits& limits = room.training->session().limits;
  const double distance = surface_distances(*room.training->session().pipeline, camera, limits, click.pixels).front();
  EXPECT_LT(length(loop.places_of(0).front() - point_at(camera, limits, {20, 18}, distance)), 1e-6);
  EXPECT_GT(loop.places_of(0).size(), 1u) << "and what looks alike around it";
}

TEST(Places, AreFoundOnceAndAFewAtATime) {
  LoopedRoom room(60);
  LabelLoop& loop = *room.loop;
  std::vector<LabelledPixels> clicks = room.clicks(4);
  EXPECT_FALSE(loop.find_places(clicks, 0)) << "one at least, and no more without time";
  EXPECT_FALSE(loop.places_of(0).empty());
  EXPECT_TRUE(loop.places_of(1).empty());
  int turns = 1;
  while (!loop.find_places(clicks, 0)) ++turns;
  EXPECT_EQ(turns, 3);
  const std::int64_t found = loop.places_found();
  EXPECT_EQ(found, 4);
  clicks.push_back(room.click(3, {30, 20}));
  clicks.erase(clicks.begin());
  EXPECT_TRUE(loop.find_places(clicks, 0));
  EXPECT_EQ(loop.places_found(), found + 1) << "those of earlier clicks are kept";
  loop.renew_places();
  EXPECT_TRUE(loop.find_places(clicks, 0));
  EXPECT_EQ(loop.places_found(), found + 1) << "old ones serve meanwhile";
  loop.refresh_places(clicks, 1e9);
  EXPECT_EQ(loop.places_found(), found + 5);
  loop.refresh_places(clicks, 1e9);
  EXPECT_EQ(loop.places_found(), found + 5);
}

// What is learned from does not grow with the strokes over the same surface, and each weighs as it did.
TEST(Places, ManyStrokesOverTheSameSurfaceCountItOnce) {
  LoopedRoom room;
  std::vector<LabelledPixels> strokes{whole_view(2)};
  room.loop->learn(strokes);
  const std::size_t once = room.loop->learned_points();
  EXPECT_GT(once, 50u);
  for (int i = 0; i < 20; ++i) strokes.push_back(whole_view(2));
  room.loop->learn(strokes);
  EXPECT_EQ(room.loop->learned_points(), once);
}

// Pixels that clicks and strokes name: those that the labels of training get, the clicked one first.

constexpr std::int32_t kWidth = 23, kHeight = 17;

std::set<std::pair<int, int>> set_of(const std::vector<PixelPlace>& pixels) {
  std::set<std::pair<int, int>> out;
  for (const PixelPlace& p : pixels) out.emplace(p.column, p.row);
  EXPECT_EQ(out.size(), pixels.size()) << "a pixel is named twice";
  return out;
}

Annotations::Mark mark_of(std::vector<PixelPoint> points, double radius) {
  Annotations::Mark mark;
  mark.points = std::move(points);
  mark.radius_px = radius;
  mark.class_index = 2;
  return mark;
}

double distance(PixelPoint p, PixelPoint a, PixelPoint b) {
  const double dx = b.x - a.x, dy = b.y - a.y, square = dx * dx + dy * dy;
  const double t = square > 0 ? std::clamp(((p.x - a.x) * dx + (p.y - a.y) * dy) / square, 0.0, 1.0) : 0.0;
  return std::hypot(a.x + t * dx - p.x, a.y + t * dy - p.y);
}

// Whether a way passes through a pixel: the fractions of it that lie between the pixel's sides have one in common.
bool passes(PixelPoint a, PixelPoint b, int column, int row) {
  double from = 0, to = 1;
  for (const auto& [start, way, side] : {std::tuple{a.x, b.x - a.x, column}, {a.y, b.y - a.y, row}}) {
    if (way == 0) {
      if (start < side || start >= side + 1) return false;
      continue;
    }
    const double t0 = (side - start) / way, t1 = (side + 1 - start) / way;
    from = std::max(from, std::min(t0, t1));
    to = std::min(to, std::max(t0, t1));
  }
  return from <= to;
}

TEST(MarkPixels, ClicksAndStrokesAreThoseOfABruteForce) {
  const RandomAddress random{7, 0, stream_id("mark_pixels_test")};
  std::uint64_t n = 0;
  const auto any = [&](double most) { return static_cast<double>(uniform01(random, n++)) * most; };
  for (int round = 0; round < 40; ++round) {
    std::vector<PixelPoint> points;
    for (int k = 0; k <= round % 4; ++k) points.push_back({any(kWidth), any(kHeight)});
    const double radius = round % 3 == 0 ? 0 : any(5);
    SCOPED_TRACE(testing::Message() << "round " << round << ", radius " << radius);
    const std::set<std::pair<int, int>> named = set_of(pixels_of(mark_of(points, radius), kWidth, kHeight));
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        bool wanted = false;
        for (std::size_t k = 0; k < points.size(); ++k) {
          const PixelPoint a = points[k], b = points[std::min(k + 1, points.size() - 1)];
          wanted = wanted || distance({x + 0.5, y + 0.5}, a, b) <= radius || passes(a, b, x, y);
        }
        EXPECT_EQ(named.contains({x, y}), wanted) << x << ", " << y;
      }
    }
  }
}

TEST(MarkPixels, TheClickedPixelComesFirst) {
  for (const double radius : {0.0, 0.7, 6.0}) {
    const std::vector<PixelPlace> pixels = pixels_of(mark_of({{10.2, 9.9}, {3.5, 4.5}}, radius), kWidth, kHeight);
    ASSERT_FALSE(pixels.empty());
    EXPECT_EQ(pixels.front().column, 10);
    EXPECT_EQ(pixels.front().row, 9);
  }
}

// The far corner of the image is a place of its last pixel.
TEST(MarkPixels, BordersBelongToTheImage) {
  const std::vector<PixelPlace> pixels = pixels_of(mark_of({{kWidth, kHeight}}, 0), kWidth, kHeight);
  ASSERT_EQ(pixels.size(), 1u);
  EXPECT_EQ(pixels[0].column, kWidth - 1);
  EXPECT_EQ(pixels[0].row, kHeight - 1);
  EXPECT_EQ(pixels_of(mark_of({{0, 0}}, 1e6), kWidth, kHeight).size(), static_cast<std::size_t>(kWidth * kHeight));
  EXPECT_TRUE(pixels_of(mark_of({}, 3), kWidth, kHeight).empty());
}

TEST(MarkPixels, WhatALaterClickPaintedOverIsLeftOut) {
  std::vector<std::int16_t> painted(kWidth * kHeight, 2);
  const std::vector<PixelPlace> all = pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight, painted);
  EXPECT_EQ(set_of(all), set_of(pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight)));
  for (int y = 0; y < kHeight; ++y)
    for (int x = 9; x < kWidth; ++x) painted[y * kWidth + x] = 1;
  const std::vector<PixelPlace> left = pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight, painted);
  EXPECT_EQ(left.front().column, 8);
  std::set<std::pair<int, int>> expected;
  for (const PixelPlace& p : all)
    if (p.column < 9) expected.emplace(p.column, p.row);
  EXPECT_EQ(set_of(left), expected);
  EXPECT_LT(left.size(), all.size());
}

// Which click is proposed next, and why, and how clicks calibrate confidence.

// The room's surface, and what is known of it.
struct Known {
  SeenRoom room;
  SurfacePool pool = make_surface_pool(room.views, room_limits(), 600);
  SurfaceGraph graph{pool, {}};
  std::vector<float> probability;
  std::vector<std::int32_t> passed;

  ProposalInput input(std::uint64_t seed = 1, std::uint64_t round = 0) const {
    return ProposalInput{.pool = &pool,
                         .graph = &graph,
                         .probability = probability,
                         .classes = 3,
                         .passed = passed,
                         .seed = seed,
                         .round = round};
  }
  std::int32_t click(std::int16_t cls, std::int32_t point) {
    graph.add({point, cls});
    return point;
  }
};

TEST(Proposals, TheSameSeedAndRoundAskTheSameForAnyThreads) {
  Known known;
  known.click(0, 3);
  for (std::size_t i = 0; i < known.pool.points.size(); ++i) {  // two that are alike but at point 20
    const float sure = i == 20 ? 0.5F : 0.97F;
    known.probability.insert(known.probability.end(), {sure, 1 - sure, 0.0F});
  }
  for (std::uint64_t round = 0; round < 6; ++round) {
    const auto made = [&] { return *choose_click(known.input(9, round)); };
    const Asked one = on_threads(1, made), three = on_threads(3, made);
    EXPECT_EQ(one.point, three.point);
    EXPECT_EQ(one.gain, three.gain);
  }
}

// One class is named at one place: what is far from it by way of the surface is proposed, however sure the network is.
TEST(Proposals, WithOneClassTheOpenSurfaceIsAskedFor) {
  Known known;
  const std::int32_t clicked = known.click(0, 10);
  for (std::size_t i = 0; i < known.pool.points.size(); ++i)
    known.probability.insert(known.probability.end(), {1.0F, 0.0F, 0.0F});
  for (std::uint64_t round = 0; round < 10; ++round) {
    const Asked asked = *choose_click(known.input(2, round));
    EXPECT_NE(asked.point, clicked);
    EXPECT_TRUE(known.pool.points[asked.point].interior);
    EXPECT_GT(asked.gain, 0);
    const float way = known.graph.settled()[asked.point].cost[0];
    EXPECT_GT(way, ProposalRules().reach);
    EXPECT_EQ(asked.why, way >= ProposalRules().unseen ? "unseen" : "uncertain");
  }
}

// Points of two looks, and a place of one of them is clicked: the others are asked for, until there are many clicks.
TEST(Proposals, TheFirstQuestionsAreAboutWhatLooksUnlikeTheClicked) {
  Known known;
  std::vector<PoolPoint>& points = known.pool.points;
  for (std::size_t i = 0; i < points.size(); ++i) points[i].color = i % 2 == 1 ? Vec3d{0.9, 0.2, 0.2} : Vec3d{};
  for (PoolPoint& point : points) point.normal = {0, 0, 1};
  known.click(0, 2);
  const auto red = [&](std::size_t clicks) {
    int found = 0;
    for (std::uint64_t round = 0; round < 40; ++round) {
      ProposalInput input = known.input(3, round);
      input.clicks = clicks;
      input.rules.reach = 1e-3F;  // a point by itself
      found += choose_click(input)->point % 2 == 1;
    }
    return found;
  };
  EXPECT_EQ(red(1), 40);
  EXPECT_LT(red(100), 30);
}

TEST(Proposals, WhatWasPassedOverIsNotAskedAgain) {
  Known known;
  known.click(0, 0);
  SurfaceGraph::Scratch scratch;
  std::vector<SurfaceGraph::Near> near;
  for (int turn = 0; turn < 12; ++turn) {
    const Asked asked = *choose_click(known.input(4, static_cast<std::uint64_t>(turn)));
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
