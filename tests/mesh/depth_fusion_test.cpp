// Depth of views of a ball before a wall, fused: where the surface lies, and what no view saw.
#include <gtest/gtest.h>

#include <cmath>

#include "surface/mesh/field_surface.h"

namespace semfield {
namespace {

constexpr double kRadius = 0.5, kWall = 1.2;  // ball at the origin, wall z = kWall

// Distance along a unit ray; 0: it meets nothing.
double met(Vec3d origin, Vec3d direction, bool with_wall) {
  const double b = dot(origin, direction), c = dot(origin, origin) - kRadius * kRadius, root = b * b - c;
  if (root > 0 && -b - std::sqrt(root) > 0) return -b - std::sqrt(root);
  if (!with_wall || !(direction.z > 0)) return 0;
  return (kWall - origin.z) / direction.z;
}

// At `eye`, looking at the origin.
DepthView view_from(Vec3d eye, bool with_wall = true, std::int32_t stride = 1) {
  DepthView view;
  view.camera.camera = {120, 90, 100, 100, 60, 45};
  const Vec3d forward = eye * (-1 / length(eye));
  const Vec3d aside = cross(std::abs(forward.y) < 0.9 ? Vec3d{0, 1, 0} : Vec3d{1, 0, 0}, forward);
  const Vec3d right = aside * (1 / length(aside)), down = cross(forward, right);
  Pose& pose = view.camera.world_from_camera;
  for (std::size_t i = 0; i < 3; ++i)
    pose.r[i] = {right[static_cast<int>(i)], down[static_cast<int>(i)], forward[static_cast<int>(i)]};
  pose.t = eye;
  SurfaceMap& map = view.map;
  map.stride = stride;
  map.width_px = strided_px(120, stride);
  map.height_px = strided_px(90, stride);
  for (std::int64_t i = 0; i < std::int64_t{map.width_px} * map.height_px; ++i) {
    const PixelPlace at = strided_place(i, map.width_px, stride);
    const Vec3d local = view.camera.camera.direction(at.column + 0.5, at.row + 0.5);
    const Vec3d ray = right * local.x + down * local.y + forward * local.z;
    map.distance_m.push_back(static_cast<float>(met(eye, ray, with_wall)));
  }
  return view;
}

RayLimits limits() {
  RayLimits limits;
  limits.near_m = 0.05;
  limits.far_m = 20;
  return limits;
}

VoxelGrid grid(double spacing) { return VoxelGrid::covering({{-1.5, -1.5, -1.5}, {1.5, 1.5, 1.5}}, spacing); }

std::vector<DepthView> around(std::int32_t stride = 1) {
  std::vector<DepthView> views;
  for (int k = 0; k < 8; ++k) {
    const double angle = k * 0.7853981633974483;
    views.push_back(view_from({2 * std::cos(angle), 2 * std::sin(angle), -1.2}, true, stride));
  }
  return views;
}

// Of a vertex, from the ball or the wall, whichever is nearer.
double off(Vec3d p) { return std::min(std::abs(length(p) - kRadius), std::abs(p.z - kWall)); }

TEST(DepthFusion, LiesOnWhatTheViewsShow) {
  for (const std::int32_t stride : {1, 2}) {
    const double spacing = 0.05;
    const Surface surface = fused_surface(around(stride), limits(), grid(spacing));
    ASSERT_GT(surface.triangles.size(), 2000U);
    double sum = 0, most = 0;
    for (const Vec3d& p : surface.positions) sum += off(p), most = std::max(most, off(p));
    EXPECT_LT(sum / static_cast<double>(surface.positions.size()), 0.15 * spacing) << stride;
    EXPECT_LT(most, kAgreeCells * spacing * 1.5) << stride;
  }
}

TEST(DepthFusion, FacesTheCameras) {
  const Surface surface = fused_surface(around(), limits(), grid(0.05));
  std::size_t wrong = 0;
  for (std::size_t i = 0; i < surface.positions.size(); ++i) {
    const Vec3d p = surface.positions[i];
    const Vec3d outward = std::abs(length(p) - kRadius) < std::abs(p.z - kWall) ? p : Vec3d{0, 0, -1};
    wrong += dot(surface.normals[i], outward) < 0 ? 1 : 0;
  }
  EXPECT_LT(wrong, surface.positions.size() / 100);
}

// Behind the ball, behind the wall and outside the images nobody knows anything.
TEST(DepthFusion, EndsWhereNobodySaw) {
  const std::vector<DepthView> one{view_from({0, 0, -2})};
  const double spacing = 0.05;
  const Surface surface = fused_surface(one, limits(), grid(spacing));
  ASSERT_GT(surface.triangles.size(), 500U);
  for (const Vec3d& p : surface.positions) {
    const bool on_ball = std::abs(length(p) - kRadius) < std::abs(p.z - kWall);
    EXPECT_LT(off(p), 2 * kAgreeCells * spacing) << "the slope of a corner may double it";
    EXPECT_TRUE(!on_ball || p.z < 0.05) << "the far half of the ball";
    EXPECT_TRUE(on_ball || std::hypot(p.x, p.y) > 0.6) << "the wall in the ball's shadow";
  }
  EXPECT_TRUE(fused_surface({}, limits(), grid(0.1)).triangles.empty());
}

// One view of eight shows the ball 0.3 nearer than it is: the others look through that place.
TEST(DepthFusion, OtherViewsRefuteWhatOneAloneShows) {
  std::vector<DepthView> views = around();
  for (float& d : views[0].map.distance_m) d -= 0.3F;
  const double spacing = 0.05;
  const Surface surface = fused_surface(views, limits(), grid(spacing));
  std::size_t wrong = 0;
  for (const Vec3d& p : surface.positions) wrong += off(p) > 2 * spacing ? 1 : 0;
  EXPECT_LT(wrong, surface.positions.size() / 50);
}

// Rays that meet nothing say that there is nothing.
TEST(DepthFusion, ARayThatMeetsNothingIsEmptySpace) {
  std::vector<DepthView> views;
  for (int k = 0; k < 6; ++k) views.push_back(view_from({2 * std::cos(k * 1.05), 0.4, 2 * std::sin(k * 1.05)}, false));
  const Surface surface = fused_surface(views, limits(), grid(0.05));
  ASSERT_GT(surface.triangles.size(), 500U);
  for (const Vec3d& p : surface.positions) EXPECT_NEAR(length(p), kRadius, 0.1);
}

// Rendered depth is a mean: at the ball's outline pixels lie between ball and wall, where there is nothing.
TEST(DepthFusion, PixelsBetweenTwoSurfacesShowNone) {
  DepthView view = view_from({0, 0, -2});
  const std::vector<float> sharp = view.map.distance_m;
  const std::int32_t width = view.map.width_px;
  std::size_t between = 0;
  for (std::size_t i = 1; i + 1 < sharp.size(); ++i) {
    if (static_cast<std::int32_t>(i) % width == 0 || !(std::abs(sharp[i - 1] - sharp[i + 1]) > 0.8F)) continue;
    view.map.distance_m[i] = (sharp[i - 1] + sharp[i + 1]) / 2;
    ++between;
  }
  ASSERT_GT(between, 50U);
  const double spacing = 0.05;
  const std::vector<DepthView> one{view};
  const Surface surface = fused_surface(one, limits(), grid(spacing));
  ASSERT_GT(surface.triangles.size(), 500U);
  std::size_t wrong = 0;
  for (const Vec3d& p : surface.positions) wrong += off(p) > 2 * kAgreeCells * spacing ? 1 : 0;
  EXPECT_LT(wrong, surface.positions.size() / 200);
}

}  // namespace
}  // namespace semfield
