// Rays and distances against a room in closed form.
#include "datasets/obj_room/raycast.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "compute/parallel.h"
#include "datasets/obj_room/tests/obj_testing.h"

namespace semfield {
namespace {

using namespace testing_obj;

std::vector<Vec3d> directions(int count) {
  std::vector<Vec3d> out;
  for (int i = 0; i < count; ++i) {
    const double z = 1 - (2 * i + 1.0) / count, r = std::sqrt(1 - z * z), phi = 2.399963229728653 * i;
    out.push_back({r * std::cos(phi), r * std::sin(phi), z});
  }
  return out;
}

TEST(Raycast, EveryDirectionMeetsTheRightObjectAtTheRightDistance) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  int crate = 0;
  for (const Vec3d origin : {Vec3d{0.1, -1, 1.2}, Vec3d{-1.7, 1.3, 2.3}}) {
    for (const Vec3d d : directions(4000)) {
      const RayHit hit = rays.trace(origin, d);
      const Truth truth = room_truth(origin, d);
      ASSERT_TRUE(hit.hit());
      EXPECT_NEAR(hit.distance_m, truth.distance, 1e-6 * (1 + truth.distance));
      EXPECT_EQ(mesh.object_of[static_cast<std::size_t>(hit.triangle)], truth.object)
          << d.x << ' ' << d.y << ' ' << d.z;
      crate += truth.object >= 6 ? 1 : 0;
      // The barycentric weights lead to the same point.
      const auto& t = mesh.triangles[static_cast<std::size_t>(hit.triangle)];
      const Vec3f p =
          mesh.positions[t[0]] * (1 - hit.b1 - hit.b2) + mesh.positions[t[1]] * hit.b1 + mesh.positions[t[2]] * hit.b2;
      const Vec3d q = origin + d * truth.distance;
      EXPECT_NEAR(length(Vec3d{p.x, p.y, p.z} - q), 0, 2e-5);
    }
  }
  EXPECT_GT(crate, 50);
}

TEST(Raycast, ReachesEndWhereAsked) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const Vec3d origin{0, -1, 1.5}, ahead{0, 1, 0};
  EXPECT_FALSE(rays.trace(origin, ahead, 2.4).hit());
  EXPECT_TRUE(rays.trace(origin, ahead, 2.6).hit());
  EXPECT_FALSE(rays.blocked(origin, ahead, 2.4));
  EXPECT_TRUE(rays.blocked(origin, ahead, 2.6));
  EXPECT_FALSE(rays.trace({0, 0, 10}, {0, 0, 1}).hit());
  EXPECT_FALSE(rays.blocked({0, 0, 10}, {0, 0, 1}, 1e6));
}

TEST(Raycast, ClearanceIsTheDistanceToTheNearestSurface) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const auto outside = [](double x, double lo, double hi) { return std::max({lo - x, 0.0, x - hi}); };
  int near_crate = 0;
  for (const Vec3d d : directions(500)) {
    const Vec3d p{1.9 * d.x, 1.4 * d.y, 1.25 + 1.2 * d.z};
    double expected = 1e300;
    for (int a = 0; a < 3; ++a) expected = std::min({expected, p[a] - kRoom.lo[a], kRoom.hi[a] - p[a]});
    const double crate = length(Vec3d{outside(p.x, kCrate.lo.x, kCrate.hi.x), outside(p.y, kCrate.lo.y, kCrate.hi.y),
                                      outside(p.z, kCrate.lo.z, kCrate.hi.z)});
    if (crate == 0) continue;  // within the crate
    near_crate += crate < expected ? 1 : 0;
    expected = std::min(expected, crate);
    EXPECT_NEAR(rays.clearance(p, 100), expected, 1e-9);
    EXPECT_EQ(rays.clearance(p, 0.5 * expected), 0.5 * expected);
  }
  EXPECT_GT(near_crate, 10);
}

TEST(Raycast, CutOutsLetRaysThroughWhereTheTestSaysSo) {
  const TriangleMesh mesh = room_mesh();
  std::vector<bool> cut_out(mesh.size());
  for (std::size_t i = 0; i < mesh.size(); ++i) cut_out[i] = mesh.object_of[i] >= 6;
  const Vec3d origin{0, -1, 0.5}, ahead{0, 1, 0};
  const auto object_ahead = [&](const Raycaster& rays) {
    return mesh.object_of[static_cast<std::size_t>(rays.trace(origin, ahead).triangle)];
  };
  const Raycaster open(mesh, cut_out, [](std::int64_t, float, float) { return false; });
  const Raycaster shut(mesh, cut_out, [](std::int64_t, float, float) { return true; });
  EXPECT_EQ(object_ahead(open), 3);
  EXPECT_FALSE(open.blocked(origin, ahead, 2));
  EXPECT_EQ(object_ahead(shut), 8);
  EXPECT_TRUE(shut.blocked(origin, ahead, 2));
  // Only the front of the crate is open: its back stops the ray, and the test is asked about crate triangles alone.
  const Raycaster front(mesh, cut_out, [&](std::int64_t t, float, float) {
    EXPECT_GE(mesh.object_of[static_cast<std::size_t>(t)], 6);
    return mesh.object_of[static_cast<std::size_t>(t)] != 8;
  });
  EXPECT_EQ(object_ahead(front), 9);
}

TEST(Raycast, SameHitsFromAnyThread) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const std::vector<Vec3d> d = directions(3000);
  const auto all = [&](int threads) {
    set_thread_count(threads);
    std::vector<std::pair<std::int64_t, double>> out(d.size());
    parallel_for(static_cast<std::int64_t>(d.size()), [&](std::int64_t i) {
      const RayHit hit = rays.trace({0.3, -0.4, 1.1}, d[static_cast<std::size_t>(i)]);
      out[static_cast<std::size_t>(i)] = {hit.triangle, hit.distance_m};
    });
    set_thread_count(0);
    return out;
  };
  EXPECT_EQ(all(1), all(2));
}

}  // namespace
}  // namespace semfield
