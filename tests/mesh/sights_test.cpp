// What cameras see of surfaces whose shape is a formula.
#include "surface/mesh/sights.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>

#include "compute/parallel.h"
#include "scene/camera_path.h"
#include "surface/mesh/marching_cubes.h"

namespace semfield {
namespace {

constexpr double kCell = 0.04;

// Where `solid` is positive, in a cube of 3 m.
Surface surface_of(const std::function<double(Vec3d)>& solid) {
  const VoxelGrid grid = VoxelGrid::covering({{-1.5, -1.5, -1.5}, {1.5, 1.5, 1.5}}, kCell);
  Surface surface = marching_cubes(grid, 0, [&](std::int64_t z, std::span<double> values) {
    for (std::int64_t i = 0; i < grid.layer_points(); ++i) {
      values[static_cast<std::size_t>(i)] = solid(
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}));
    }
  });
  set_vertex_normals(surface);
  return surface;
}

double ball(Vec3d p, Vec3d center, double radius) { return radius - length(p - center); }
// Walls around [-1, 1]^3.
double walls(Vec3d p) { return std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)}) - 1; }

RayCamera camera_at(Vec3d place, Vec3d towards) {
  const Vec3d up = std::abs(normalized(towards - place).z) > 0.9 ? Vec3d{0, 1, 0} : Vec3d{0, 0, 1};
  return {{160, 120, 100, 100, 80, 60}, look_along(place, normalized(towards - place), up), true};
}

// Cameras that look every way from a place.
std::vector<RayCamera> around(Vec3d place) {
  std::vector<RayCamera> out;
  for (int axis = 0; axis < 3; ++axis) {
    for (const double sign : {-1.0, 1.0}) {
      Vec3d ahead;
      ahead[axis] = sign;
      RayCamera camera = camera_at(place, place + ahead);
      camera.camera = {160, 160, 70, 70, 80, 80};
      out.push_back(camera);
    }
  }
  return out;
}

RayLimits limits() {
  RayLimits out;
  out.near_m = 0.05;
  out.far_m = 10;
  return out;
}

Surface seen_of(Surface surface, const std::vector<RayCamera>& cameras) {
  keep_triangles(surface, triangles_in_sight(surface, sights_of(surface, cameras, limits(), kCell)));
  return surface;
}

// A room with a hollow behind one wall, which is where a field holds what it likes.
TEST(Sights, WhatLiesBehindAWallGoesAndTheRoomStaysWhole) {
  const Vec3d hollow{1.25, 0, 0};
  const auto solid = [&](Vec3d p) { return std::min(walls(p), -ball(p, hollow, 0.15)); };
  const Surface all = surface_of(solid), room = surface_of(walls);
  const Surface kept = seen_of(all, around({0.1, -0.2, 0.1}));
  EXPECT_GT(all.triangles.size(), room.triangles.size() + 100);
  EXPECT_EQ(kept.triangles.size(), room.triangles.size());
  for (const Vec3d& p : kept.positions) EXPECT_GT(length(p - hollow), 0.2);
}

// A pillar hides a part of the wall behind it.
TEST(Sights, OneCameraLeavesAShadowThatASecondOneFills) {
  const Vec3d pillar{0.3, 0, 0};
  const auto solid = [&](Vec3d p) { return std::max(walls(p), 0.3 - std::hypot(p.x - pillar.x, p.y - pillar.y)); };
  const Surface all = surface_of(solid);
  const RayCamera front = camera_at({-0.9, 0, 0}, {1, 0, 0});
  const auto in_shadow = [](const Surface& surface) {
    return std::count_if(surface.positions.begin(), surface.positions.end(),
                         [](const Vec3d& p) { return p.x > 0.99 && std::abs(p.y) < 0.3 && std::abs(p.z) < 0.5; });
  };
  ASSERT_GT(in_shadow(all), 200);
  const Surface one = seen_of(all, {front});
  EXPECT_EQ(in_shadow(one), 0);
  const bool beside = std::any_of(one.positions.begin(), one.positions.end(),
                                  [](const Vec3d& p) { return p.x > 0.99 && std::abs(p.y) > 0.85; });
  EXPECT_TRUE(beside) << "the wall beside the shadow is there";
  EXPECT_EQ(in_shadow(seen_of(all, {front, camera_at({0.8, -0.9, 0}, {1, 0, 0}), camera_at({0.8, 0.9, 0}, {1, 0, 0})})),
            in_shadow(all));
}

TEST(Sights, NoFringeIsLeftAtTheRimOfWhatIsSeen) {
  const Surface all = surface_of([](Vec3d p) { return ball(p, {0, 0, 0}, 1); });
  const RayCamera camera = camera_at({-4, 0, 0}, {0, 0, 0});
  const Surface kept = seen_of(all, {camera});
  ASSERT_FALSE(kept.positions.empty());
  // A camera at a distance of 4 sees the ball up to x = -1/4.
  for (const Vec3d& p : kept.positions) EXPECT_LT(p.x, -0.25 + 3 * kCell);
  const auto near_rim = std::count_if(kept.positions.begin(), kept.positions.end(),
                                      [](const Vec3d& p) { return p.x > -0.25 - 3 * kCell; });
  EXPECT_GT(near_rim, 100) << "and little of it is missing";
}

// What stands on a table is seen from all sides but one.
TEST(Sights, AnObjectThatIsSeenButForALittleStaysClosed) {
  const auto solid = [](Vec3d p) { return std::min(ball(p, {0, 0, 0}, 1), p.z + 0.85); };
  const Surface all = surface_of(solid);
  std::vector<RayCamera> cameras;
  for (int i = 0; i < 8; ++i) cameras.push_back(camera_at({3 * std::cos(i * 0.785), 3 * std::sin(i * 0.785), 0.5}, {}));
  cameras.push_back(camera_at({0.01, 0, 3}, {}));
  const std::vector<Sights> sights = sights_of(all, cameras, limits(), kCell);
  std::int64_t below = 0, unseen = 0;
  for (std::size_t v = 0; v < sights.size(); ++v) {
    if (all.positions[v].z > -0.84 || std::hypot(all.positions[v].x, all.positions[v].y) > 0.45) continue;
    ++below;
    unseen += sights[v].any() ? 0 : 1;
  }
  ASSERT_GT(below, 200);
  EXPECT_EQ(unseen, below);
  EXPECT_EQ(seen_of(all, cameras).triangles.size(), all.triangles.size());
}

TEST(Sights, AreTheCamerasThatShowAPointLargestAndLendThemselves) {
  const Surface all = surface_of([](Vec3d p) { return ball(p, {0, 0, 0}, 1); });
  const std::vector<RayCamera> cameras{camera_at({-4, 0, 0}, {}), camera_at({-2.5, 0, 0}, {}), camera_at({4, 0, 0}, {}),
                                       camera_at({-3, 1, 0}, {}), camera_at({-3, -1, 0}, {})};
  std::vector<Sights> sights = sights_of(all, cameras, limits(), kCell);
  const auto vertex = [&](Vec3d wanted) {
    const auto nearest =
        std::min_element(all.positions.begin(), all.positions.end(),
                         [&](const Vec3d& a, const Vec3d& b) { return length(a - wanted) < length(b - wanted); });
    return static_cast<std::size_t>(nearest - all.positions.begin());
  };
  const std::size_t left = vertex({-1, 0, 0}), right = vertex({1, 0, 0}), top = vertex({0, 0, 1});
  EXPECT_EQ(sights[left].camera[0], 1) << "the nearest";
  EXPECT_TRUE(std::is_sorted(sights[left].weight.rbegin(), sights[left].weight.rend()));
  EXPECT_GE(sights[left].camera[2], 0);
  EXPECT_EQ(sights[right].camera, (std::array<std::int32_t, 3>{2, -1, -1}));
  EXPECT_FALSE(sights[top].any());

  const Looks facing = looks_at(all.positions[right], all.normals[right], sights[right], cameras);
  ASSERT_EQ(facing.count, 1U);
  EXPECT_LT(length(facing.direction[0] - Vec3d{-1, 0, 0}), 0.05);
  EXPECT_EQ(facing.weight[0], 1);
  const Looks three = looks_at(all.positions[left], all.normals[left], sights[left], cameras);
  ASSERT_EQ(three.count, 3U);
  EXPECT_NEAR(three.weight[0] + three.weight[1] + three.weight[2], 1, 1e-12);
  const Looks nobody = looks_at(all.positions[top], all.normals[top], sights[top], cameras);
  EXPECT_EQ(nobody.direction[0], all.normals[top] * -1.0);

  lend_sights(all, sights);
  EXPECT_TRUE(std::all_of(sights.begin(), sights.end(), [](const Sights& s) { return s.any(); }));
  // A camera that was lent may look at the back: then nobody's direction is taken.
  const Looks back = looks_at({0, 0, 0}, {1, 0, 0}, Sights{{0, -1, -1}, {1, 0, 0}}, cameras);
  EXPECT_EQ(back.direction[0], (Vec3d{-1, 0, 0}));
}

TEST(Sights, FollowTheLensAndTheLimitsAndNotTheThreads) {
  const Surface all = surface_of([](Vec3d p) { return std::max(walls(p), ball(p, {0, 0, 0}, 0.3)); });
  std::vector<RayCamera> cameras = around({-0.7, 0.1, 0});
  const auto flags = [&](const RayLimits& most) {
    std::vector<char> out;
    for (const Sights& s : sights_of(all, cameras, most, kCell)) out.push_back(s.any() ? 1 : 0);
    return out;
  };
  const std::vector<char> wide = flags(limits());
  RayLimits short_sighted = limits();
  short_sighted.far_m = 1;
  const std::vector<char> near = flags(short_sighted);
  for (std::size_t v = 0; v < all.positions.size(); ++v) {
    if (near[v] == 0) continue;
    EXPECT_LE(length(all.positions[v] - Vec3d{-0.7, 0.1, 0}), 1 + 1e-9);
  }
  // A barrel lens sees further to the side than the pinhole of its focal length.
  cameras.resize(1);
  const std::vector<char> pinhole = flags(limits());
  cameras[0].camera.k1 = -0.2;
  const std::vector<char> barrel = flags(limits());
  cameras[0].undistort = false;
  EXPECT_EQ(flags(limits()), pinhole) << "whoever does not undistort, casts rays of a pinhole";
  const auto count = [](const std::vector<char>& of) { return std::count(of.begin(), of.end(), 1); };
  EXPECT_GT(count(barrel), count(pinhole) + 100);

  cameras = around({-0.7, 0.1, 0});
  const int threads = thread_count();
  set_thread_count(1);
  EXPECT_EQ(flags(limits()), wide);
  set_thread_count(threads);
}

}  // namespace
}  // namespace semfield
