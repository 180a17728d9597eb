// Distances to triangles, and scores of meshes whose share of right and missing area is known: a box seen from inside.
#include "surface/mesh/score/mesh_score.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/rng.h"

namespace semfield {
namespace {

constexpr double kHalf = 0.503;  // of the box's side; no wall lies on the border of a cube of kPointCube

// The box of half side `half`; faces look inward, those of wall w are triangles 2 w and 2 w + 1.
Surface box(double half = kHalf) {
  Surface surface;
  for (int i = 0; i < 8; ++i)
    surface.positions.push_back(
        {(i & 1) != 0 ? half : -half, (i & 2) != 0 ? half : -half, (i & 4) != 0 ? half : -half});
  for (const auto& wall : {std::array<std::uint32_t, 4>{0, 2, 6, 4},
                           {1, 3, 7, 5},
                           {0, 1, 5, 4},
                           {2, 3, 7, 6},
                           {0, 1, 3, 2},
                           {4, 5, 7, 6}}) {
    surface.triangles.push_back({wall[0], wall[1], wall[2]});
    surface.triangles.push_back({wall[0], wall[2], wall[3]});
  }
  return surface;
}

// A square of the given side that lies level, its middle at `at`.
void add_square(Surface& surface, Vec3d at, double side) {
  const auto first = static_cast<std::uint32_t>(surface.positions.size());
  for (const auto& [x, y] : {std::pair{-0.5, -0.5}, {0.5, -0.5}, {0.5, 0.5}, {-0.5, 0.5}})
    surface.positions.push_back(at + Vec3d{x * side, y * side, 0});
  surface.triangles.push_back({first, first + 1, first + 2});
  surface.triangles.push_back({first, first + 2, first + 3});
}

// From the middle along an axis: 0 to 5 are x, -x, y, -y, z, -z. 100 degrees wide.
DepthView look(int way) {
  constexpr std::int32_t kSide = 238;
  RayCamera camera;
  camera.camera = {kSide, kSide, 100, 100, kSide / 2.0, kSide / 2.0};
  const int axis = way / 2;
  const double sign = way % 2 == 0 ? 1 : -1;
  Vec3d forward, right;
  forward[axis] = sign;
  right[(axis + 1) % 3] = 1;
  const Vec3d down = cross(forward, right);
  for (std::size_t i = 0; i < 3; ++i)
    camera.world_from_camera.r[i] = {right[static_cast<int>(i)], down[static_cast<int>(i)],
                                     forward[static_cast<int>(i)]};
  std::vector<float> z(static_cast<std::size_t>(kSide) * kSide);
  for (std::size_t i = 0; i < z.size(); ++i) {
    const Vec3d local =
        camera.camera.direction(static_cast<double>(i % kSide) + 0.5, static_cast<double>(i / kSide) + 0.5);
    const Vec3d ray = camera.world_from_camera.rotate(local);
    const double met = kHalf / std::max({std::abs(ray.x), std::abs(ray.y), std::abs(ray.z)});
    z[i] = static_cast<float>(met * local.z);
  }
  return measured_view(camera, DepthMap(z));
}

std::vector<DepthView> all_around() {
  std::vector<DepthView> views;
  for (int way = 0; way < 6; ++way) views.push_back(look(way));
  return views;
}

TEST(NearestSurface, DistancesToABoxAreExact) {
  const Surface surface = box(0.5);
  const NearestSurface nearest(surface.positions, surface.triangles);
  EXPECT_DOUBLE_EQ(nearest.distance({0, 0, 0}, 10), 0.5) << "the middle";
  EXPECT_DOUBLE_EQ(nearest.distance({0.1, 0.2, 0.8}, 10), 0.3) << "over a wall";
  EXPECT_DOUBLE_EQ(nearest.distance({0.8, 0.1, 0.9}, 10), 0.5) << "beside an edge";
  EXPECT_DOUBLE_EQ(nearest.distance({0.7, 0.9, 0.9}, 10), 0.6) << "off a corner";
  EXPECT_DOUBLE_EQ(nearest.distance({0.5, 0.25, 0.25}, 10), 0) << "on a wall";
  EXPECT_DOUBLE_EQ(nearest.distance({0, 0, 3}, 1), 1) << "no farther than asked";
  EXPECT_DOUBLE_EQ(NearestSurface(std::vector<Vec3d>{}).distance({0, 0, 0}, 7), 7);
}

TEST(NearestSurface, FindsTheNearestOfManyPoints) {
  constexpr RandomAddress kPlace{1, 0, stream_id("test/nearest")};
  const auto random = [&](std::uint64_t i) { return static_cast<double>(uniform01(kPlace, i)); };
  std::vector<Vec3d> points;
  for (std::uint64_t i = 0; i < 1000; ++i) points.push_back({random(3 * i), random(3 * i + 1), random(3 * i + 2)});
  const NearestSurface nearest(points);
  for (std::uint64_t i = 0; i < 200; ++i) {
    const Vec3d at{2 * random(9000 + 3 * i) - 0.5, random(9001 + 3 * i), random(9002 + 3 * i)};
    double least = HUGE_VAL;
    for (const Vec3d& p : points) least = std::min(least, length(p - at));
    ASSERT_NEAR(nearest.distance(at, 10), least, 1e-12);
  }
}

TEST(MeshScore, TheSurfaceItselfIsCompleteAndAccurate) {
  const std::vector<DepthView> views = all_around();
  const DepthReference reference(views, {});
  EXPECT_NEAR(static_cast<double>(reference.points()), 6 * 1.006 * 1.006 * 1e4, 3000) << "a point a square centimetre";
  EXPECT_EQ(reference.held_out_points(), 0U);
  const MeshScore score = reference.score(box());
  EXPECT_EQ(score.complete, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.accurate, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.f, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.judged, 1);
  EXPECT_FALSE(score.complete_of_held_out);
}

TEST(MeshScore, AnOffsetCountsFromItsDistanceOn) {
  const std::vector<DepthView> views = all_around();
  const MeshScore score = DepthReference(views, {}).score(box(kHalf - 0.03));
  EXPECT_EQ(score.complete[0], 0);
  EXPECT_GT(score.complete[1], 0.999) << "corners are farther by the root of three";
  EXPECT_EQ(score.complete[2], 1);
  EXPECT_EQ(score.accurate, (ScoreShares{0, 1, 1}));
  EXPECT_EQ(score.f[0], 0);
}

TEST(MeshScore, AMissingWallIsMissingFromCompletenessAlone) {
  const std::vector<DepthView> views = all_around();
  const std::vector<DepthView> first(views.begin(), views.begin() + 4), rest(views.begin() + 4, views.end());
  const DepthReference reference(first, rest);
  Surface surface = box();
  surface.triangles.resize(10);  // without the wall at +z, which the fifth view shows
  const MeshScore score = reference.score(surface);
  for (std::size_t k = 0; k < kScoreDistances.size(); ++k) {
    // Of the wall that is away, a rim lies so near to its neighbours.
    const double inner = 1 - kScoreDistances[k] / kHalf;
    EXPECT_NEAR(score.complete[k], 1 - inner * inner / 6, 0.01) << k;
    ASSERT_TRUE(score.complete_of_held_out);
    EXPECT_LT((*score.complete_of_held_out)[k], score.complete[k]) << k;
    EXPECT_EQ(score.accurate[k], 1) << k;
    EXPECT_NEAR(score.f[k], 2 * score.complete[k] / (1 + score.complete[k]), 1e-12) << k;
  }
}

TEST(MeshScore, WhatFloatsIsWrongAndWhatNobodyMeasuredIsNotJudged) {
  const std::vector<DepthView> views = all_around();
  const DepthReference reference(views, {});
  const double walls = 24 * kHalf * kHalf;
  Surface floats = box();
  add_square(floats, {0, 0, 0.2}, 0.5);
  const MeshScore wrong = reference.score(floats);
  for (const double accurate : wrong.accurate) EXPECT_NEAR(accurate, walls / (walls + 0.25), 1e-4);
  EXPECT_EQ(wrong.judged, 1);
  Surface outside = box();
  add_square(outside, {0, 0, 3}, 0.5);
  const MeshScore unknown = reference.score(outside);
  EXPECT_EQ(unknown.accurate, (ScoreShares{1, 1, 1}));
  EXPECT_NEAR(unknown.judged, walls / (walls + 0.25), 1e-4);
}

// A sensor that measures nothing at a pixel does not say that its ray is empty.
TEST(MeshScore, PixelsWithoutDepthTakeNothingAway) {
  std::vector<DepthView> views = all_around();
  const VoxelGrid grid = VoxelGrid::covering({{-0.6, -0.6, -0.6}, {0.6, 0.6, 0.6}}, 0.02);
  const RayLimits limits;
  const DepthReference reference(views, {});
  const MeshScore whole = reference.score(fused_surface(views, limits, grid));
  EXPECT_GT(whole.complete[0], 0.98);
  EXPECT_GT(whole.accurate[0], 0.99);
  std::vector<DepthView> twice = all_around();
  for (DepthView& view : all_around()) {
    view.map.distance_m.assign(view.map.distance_m.size(), kNotKnown);
    twice.push_back(view);
  }
  const MeshScore same = reference.score(fused_surface(twice, limits, grid));
  EXPECT_EQ(same.complete, whole.complete);
  EXPECT_EQ(same.accurate, whole.accurate);
  const std::vector<DepthView> none(twice.begin() + 6, twice.end());
  EXPECT_TRUE(fused_surface(none, limits, grid).triangles.empty());
  EXPECT_EQ(DepthReference(none, {}).points(), 0U);
}

}  // namespace
}  // namespace semfield
