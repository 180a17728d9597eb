// Reprojection: two views of a plane by hand, an independent matrix product, hidden surfaces, choice of views.
#include <gtest/gtest.h>

#include <Eigen/Dense>

#include "core/rng.h"
#include "surface/fuse/fusion.h"

namespace semfield {
namespace {

Camera camera(std::int32_t size = 8, double focal = 8) {
  return Camera{.width_px = size, .height_px = size, .fx = focal, .fy = focal, .cx = size / 2.0, .cy = size / 2.0};
}

Pose at(double x, double y, double z) { return Pose{.t = {x, y, z}}; }

TEST(Correspondence, PixelCentresOnAPlaneTwoMetresAhead) {
  // Pixel (1, 3) has its centre at (1.5, 3.5): x = (1.5 - 4) / 8 * 2 = -0.625, y = -0.125, z = 2 (not along the ray).
  std::vector<float> depth(64, 2.0F);
  const PosedDepth view{camera(), at(10, 0, 0), depth};
  const auto p = surface_point(view, 1, 3);
  ASSERT_TRUE(p);
  EXPECT_NEAR(p->x, 9.375, 1e-15);
  EXPECT_NEAR(p->y, -0.125, 1e-15);
  EXPECT_NEAR(p->z, 2, 1e-15);
}

TEST(Correspondence, ShiftByTwoPixels) {
  // The second camera stands 0.5 m to the right: u falls by 8 * 0.5 / 2 = 2 pixels.
  std::vector<float> depth(64, 2.0F);
  const PosedDepth first{camera(), at(0, 0, 0), depth}, second{camera(), at(0.5, 0, 0), depth};
  const FusionParams params{.tolerance = 0.01};
  for (int row = 0; row < 8; ++row) {
    for (int column = 0; column < 8; ++column) {
      const auto hit = seen_at(second, *surface_point(first, column, row), params);
      ASSERT_EQ(hit.has_value(), column >= 2) << column;
      if (!hit) continue;
      EXPECT_EQ(hit->column, column - 2);
      EXPECT_EQ(hit->row, row);
      EXPECT_NEAR(hit->z_m, 2, 1e-14);
    }
  }
}

TEST(Correspondence, OwnViewIsTheIdentity) {
  std::vector<float> depth(64);
  for (std::size_t i = 0; i < depth.size(); ++i) depth[i] = 0.3F + 0.17F * static_cast<float>(i % 13);
  Pose pose = at(1, 2, 3);
  const double s = std::sin(0.7), c = std::cos(0.7);
  pose.r = {{{c, 0, s}, {0, 1, 0}, {-s, 0, c}}};
  const PosedDepth view{camera(), pose, depth};
  FusionParams exact{.tolerance = 1e-12, .relative_tolerance = 0};
  for (int row = 0; row < 8; ++row) {
    for (int column = 0; column < 8; ++column) {
      const auto hit = seen_at(view, *surface_point(view, column, row), exact);
      ASSERT_TRUE(hit);
      EXPECT_EQ(hit->column, column);
      EXPECT_EQ(hit->row, row);
    }
  }
}

TEST(Correspondence, BoundsAreThePixelsEdges) {
  const Camera c = camera();
  // u = 8 x / z + 4 with z = 1: x = -0.5 is the left edge, x = 0.5 the right one (outside).
  const auto hit = project_point(c, {}, {-0.5, 0, 1});
  ASSERT_TRUE(hit);
  EXPECT_EQ(hit->column, 0);
  EXPECT_EQ(hit->row, 4);
  EXPECT_FALSE(project_point(c, {}, {-0.5 - 1e-9, 0, 1}));
  EXPECT_FALSE(project_point(c, {}, {0.5, 0, 1}));
  EXPECT_TRUE(project_point(c, {}, {0.5 - 1e-9, 0, 1}));
  EXPECT_FALSE(project_point(c, {}, {0, 0, -1}));  // behind
  EXPECT_FALSE(project_point(c, {}, {0, 0, 0}));
  EXPECT_FALSE(project_point(c, {}, {NAN, 0, 1}));
  EXPECT_FALSE(project_point(c, {}, {1e300, 0, 1e-300}));
}

TEST(Correspondence, AnotherDepthIsAnotherSurface) {
  FusionParams params{.tolerance = 0.05, .relative_tolerance = 0.01};
  // At z = 2 the two allow 0.07 m.
  std::vector<float> depth(64, 2.0F);
  const PosedDepth first{camera(), {}, depth};
  const Vec3d point = *surface_point(first, 4, 4);
  for (const auto& [z, seen] : {std::pair{2.06F, true},
                                {1.94F, true},
                                {2.08F, false},
                                {1.92F, false},
                                {0.5F, false},
                                {0.0F, false},
                                {-1.0F, false},
                                {INFINITY, false},
                                {NAN, false}}) {
    std::vector<float> other(64, z);
    EXPECT_EQ(seen_at({camera(), {}, other}, point, params).has_value(), seen) << z;
    if (!(z > 0) || !std::isfinite(z)) {
      EXPECT_FALSE(surface_point({camera(), {}, other}, 0, 0)) << z;
    }
  }
  params.tolerance = 10;  // a pixel without depth agrees with nothing, however wide the tolerance
  std::vector<float> none(64, 0.0F);
  EXPECT_FALSE(seen_at({camera(), {}, none}, point, params));
}

// The same chain as 4 x 4 matrices: x_b ~ K [I | 0] B^-1 A (z K^-1 [u, v, 1], 1).
TEST(Correspondence, AgreesWithMatrices) {
  const RandomAddress address{7, 0, stream_id("test/correspondence")};
  int hits = 0;
  for (std::uint64_t trial = 0; trial < 2000; ++trial) {
    auto random = [&, k = std::uint64_t{0}](double lo, double hi) mutable {
      return lo + (hi - lo) * static_cast<double>(uniform_below(address, 32 * trial + k++, 1U << 30)) / (1U << 30);
    };
    Camera c = camera(64, random(20, 90));
    c.fy = random(20, 90);
    c.cx = random(28, 36);
    c.cy = random(28, 36);
    Eigen::Matrix4d pose[2];
    Pose ours[2];
    for (int i = 0; i < 2; ++i) {
      const Eigen::Vector3d axis = Eigen::Vector3d(random(-1, 1), random(-1, 1), random(-1, 1)).normalized();
      pose[i].setIdentity();
      pose[i].topLeftCorner<3, 3>() = Eigen::AngleAxisd(random(0, 0.6), axis).toRotationMatrix();
      pose[i].topRightCorner<3, 1>() = Eigen::Vector3d(random(-1, 1), random(-1, 1), random(-1, 1));
      for (std::size_t row = 0; row < 3; ++row) {
        for (std::size_t col = 0; col < 3; ++col)
          ours[i].r[row][col] = pose[i](static_cast<long>(row), static_cast<long>(col));
      }
      ours[i].t = {pose[i](0, 3), pose[i](1, 3), pose[i](2, 3)};
    }
    const auto z = static_cast<float>(random(1, 5));
    std::vector<float> depth(64 * 64, z);
    const auto column = static_cast<int>(random(0, 64)), row = static_cast<int>(random(0, 64));
    Eigen::Matrix3d k;
    k << c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1;
    const Eigen::Vector3d in_a = z * (k.inverse() * Eigen::Vector3d(column + 0.5, row + 0.5, 1));
    const Eigen::Vector4d world = pose[0] * in_a.homogeneous();
    const Eigen::Vector3d in_b = (pose[1].inverse() * world).head<3>();
    const Eigen::Vector3d image = k * in_b / in_b.z();
    const std::optional<Vec3d> point = surface_point({c, ours[0], depth}, column, row);
    ASSERT_TRUE(point);
    EXPECT_NEAR(point->x, world.x(), 1e-12);
    EXPECT_NEAR(point->y, world.y(), 1e-12);
    EXPECT_NEAR(point->z, world.z(), 1e-12);
    const auto hit = project_point(c, ours[1], *point);
    const bool inside = in_b.z() > 0 && image.x() >= 0 && image.x() < 64 && image.y() >= 0 && image.y() < 64;
    ASSERT_EQ(hit.has_value(), inside);
    if (!hit) continue;
    ++hits;
    EXPECT_EQ(hit->column, static_cast<int>(std::floor(image.x())));
    EXPECT_EQ(hit->row, static_cast<int>(std::floor(image.y())));
    EXPECT_NEAR(hit->z_m, in_b.z(), 1e-12);
  }
  EXPECT_GT(hits, 300);
}

TEST(Correspondence, ALensDoesNotFoldPointsBackIntoTheImage) {
  Camera c = camera();
  c.k1 = -0.3;  // r (1 - 0.3 r^2) turns round at r = 1.054
  const auto inside = project_point(c, {}, {0.4, 0, 1});
  ASSERT_TRUE(inside);
  EXPECT_FALSE(project_point(c, {}, {1.7, 0, 1}));  // 1.7 - 0.3 * 4.913 = 0.226: on the image, but no ray's
  std::vector<float> depth(64, 3.0F);
  const PosedDepth view{c, at(1, 1, 1), depth};
  for (int i = 0; i < 8; ++i) {
    const auto point = surface_point(view, i, 7 - i);
    ASSERT_TRUE(point);
    EXPECT_NEAR(view.world_from_camera.apply_inverse(*point).z, 3, 1e-12);
    const auto hit = seen_at(view, *point, {});
    ASSERT_TRUE(hit);
    EXPECT_EQ(hit->column, i);
    EXPECT_EQ(hit->row, 7 - i);
  }
}

TEST(Correspondence, ChosenViews) {
  std::vector<float> depth(64, 2.0F);
  std::vector<PosedDepth> views;
  for (const double x : {0.0, 5.0, 1.0, 0.2, 9.0}) views.push_back({camera(), at(x, 0, 0), depth});
  PosedDepth turned = views[0];  // same place, looking aside: its gaze is 2 sqrt(2) away
  turned.world_from_camera.r = {{{0, 0, 1}, {0, 1, 0}, {-1, 0, 0}}};
  views.push_back(turned);
  FusionParams params;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{1, 2, 3, 4, 5}));
  params.views = 2;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{2, 3}));
  params.views = 3;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{2, 3, 5}));  // 2.83 < 10
  params.choose = ViewChoice::even;
  params.views = 2;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4}, params), (std::vector<int>{2, 4}));
  params.views = 1;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{3}));
  params.views = 50;
  EXPECT_EQ(choose_views(views, 4, {0, 1}, params), (std::vector<int>{0, 1}));
}

}  // namespace
}  // namespace semfield
