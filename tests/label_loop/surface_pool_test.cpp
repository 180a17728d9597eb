// The surface that the views of the analytic room show, thinned to cells: points on it, as many as wanted, the same for
// any threads.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "compute/parallel.h"
#include "tests/label_loop/seen_room.h"

namespace semfield {
namespace {

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
      EXPECT_LT(length(hit.point - pool.points[static_cast<std::size_t>(n)].position), std::sqrt(3.0) * pool.cell_m());
      ++pixels[static_cast<std::size_t>(n)];
    }
  }
  std::size_t turned = 0, with_normal = 0;
  for (std::size_t i = 0; i < pool.points.size(); ++i) {
    const PoolPoint& point = pool.points[i];
    EXPECT_GT(pixels[i], 0u) << "a point that no pixel shows";
    EXPECT_EQ(pool.cells.near(point.position), static_cast<std::int32_t>(i)) << "a mean lies in its cell";
    const testkit::AnalyticHit hit = hit_at(room.views[static_cast<std::size_t>(point.view)].camera, point.pixel);
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

// Beside a step of depth no point is asked for: a click there may land on either side.
TEST(SurfacePool, BordersOfDepthAreNotInterior) {
  const SeenRoom room;
  const SurfacePool pool = make_surface_pool(room.views, room_limits(), 1000);
  int borders = 0;
  for (const PoolPoint& point : pool.points) {
    const PoolView& view = room.views[static_cast<std::size_t>(point.view)];
    const std::int32_t x = point.pixel.column / view.map.stride, y = point.pixel.row / view.map.stride;
    const bool inside = x > 0 && y > 0 && x + 1 < view.map.width_px && y + 1 < view.map.height_px;
    if (!inside) {
      EXPECT_FALSE(point.interior);
      continue;
    }
    const auto depth = [&](std::int32_t dx, std::int32_t dy) {
      return static_cast<double>(view.map.distance_m[static_cast<std::size_t>((y + dy) * view.map.width_px + x + dx)]);
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
