// Cameras: pixel centres, lens and its inverse, resizing.
#include "scene/camera.h"

#include <gtest/gtest.h>

namespace semfield {
namespace {

Camera lens_camera() {
  Camera c;
  c.width_px = 640;
  c.height_px = 480;
  c.fx = 500;
  c.fy = 510;
  c.cx = 322.5;
  c.cy = 236.25;
  return c;
}

TEST(Camera, DirectionIsUnitAndLooksForwardAtThePrincipalPoint) {
  const Camera c = lens_camera();
  const Vec3d d = c.direction(c.cx, c.cy);
  EXPECT_EQ(d.x, 0.0);
  EXPECT_EQ(d.y, 0.0);
  EXPECT_EQ(d.z, 1.0);
  EXPECT_NEAR(length(c.direction(1, 2)), 1.0, 1e-15);
  EXPECT_GT(c.direction(c.cx + 1, c.cy).x, 0.0);
  EXPECT_GT(c.direction(c.cx, c.cy + 1).y, 0.0);
}

TEST(Camera, ProjectUndoesDirectionThroughAStrongLens) {
  Camera c = lens_camera();
  c.k1 = -0.28;
  c.k2 = 0.07;
  c.k3 = -0.002;
  c.k4 = 0.0004;
  c.p1 = 0.0011;
  c.p2 = -0.0007;
  for (int y = 0; y <= 480; y += 60) {
    for (int x = 0; x <= 640; x += 64) {
      const Vec3d d = c.direction(x, y);
      ASSERT_GT(d.z, 0.0) << x << " " << y;
      double u = 0, v = 0;
      c.project(d * 3.7, u, v);
      EXPECT_NEAR(u, x, 1e-9);
      EXPECT_NEAR(v, y, 1e-9);
    }
  }
}

TEST(Camera, KnownDistortionByHand) {
  Camera c;
  c.width_px = c.height_px = 2;
  c.fx = c.fy = 1;
  c.k1 = 0.1;
  c.k4 = 0.01;
  c.p1 = 0.02;
  c.p2 = 0.03;
  double u = 0, v = 0;
  c.project({1, 0.5, 1}, u, v);
  // s = 1.25: g = 1 + 0.125 + 0.01 * 1.25^4 = 1.1494140625; x g + 2 p1 x y + p2 (s + 2 x^2) = 1.149... + 0.02 + 0.0975
  EXPECT_NEAR(u, 1.1494140625 + 0.02 + 0.0975, 1e-15);
  EXPECT_NEAR(v, 0.5 * 1.1494140625 + 0.02 * (1.25 + 0.5) + 2 * 0.03 * 0.5, 1e-15);
}

TEST(Camera, PointsBeyondTheFoldHaveNoDirection) {
  Camera c = lens_camera();
  c.k1 = -0.5;  // r (1 - 0.5 r^2) grows up to r = 0.816, where it reaches 0.544
  EXPECT_EQ(c.direction(c.cx + 0.55 * c.fx, c.cy), (Vec3d{0, 0, 0}));
  EXPECT_EQ(c.direction(c.cx, c.cy - 0.9 * c.fy), (Vec3d{0, 0, 0}));
  const Vec3d inside = c.direction(c.cx + 0.54 * c.fx, c.cy);
  ASSERT_GT(inside.z, 0.0);
  EXPECT_LT(inside.x / inside.z, 0.8165);
  EXPECT_GT(inside.x / inside.z, 0.54);
}

TEST(Camera, ResizedSeesTheSameDirections) {
  Camera c = lens_camera();
  c.k1 = -0.1;
  const Camera half = c.resized(320, 120);
  EXPECT_EQ(half.width_px, 320);
  // The corner of the image stays the corner; with centres at +0.5 a point (u, v) moves to (u / 2, v / 4).
  const Vec3d a = c.direction(640, 480), b = half.direction(320, 120);
  EXPECT_NEAR(a.x, b.x, 1e-13);
  EXPECT_NEAR(a.y, b.y, 1e-13);
  EXPECT_NEAR(half.cx, 161.25, 1e-12);
  EXPECT_NEAR(half.cy, 59.0625, 1e-12);
}

}  // namespace
}  // namespace semfield
