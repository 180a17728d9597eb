// Poses and cameras before they are believed.
#include "scene/scene_checks.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "tests/says.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

Pose rotated(double scale) {
  Pose p = testing_room::room_pose(3);
  for (auto& row : p.r) {
    for (double& v : row) v *= scale;
  }
  return p;
}

TEST(SceneChecks, GoodPosePassesUnchanged) {
  Diagnostics d;
  Pose p = testing_room::room_pose(3);
  const Pose before = p;
  EXPECT_EQ(check_pose(p, "here", d), PoseState::good);
  EXPECT_EQ(p.r, before.r);
  EXPECT_TRUE(d.all().empty());
}

TEST(SceneChecks, ScaledMirroredAndNearlyOrthonormal) {
  Diagnostics d;
  Pose scaled = rotated(1.001);
  EXPECT_EQ(check_pose(scaled, "frame 'a' (a.png)", d), PoseState::refused);
  EXPECT_EQ(unsaid(d.all().back().text(), {"frame 'a' (a.png)", "0.002 off orthonormal", "1e-3", "without a scale"}),
            "");
  Pose mirrored = testing_room::room_pose(1);
  for (auto& row : mirrored.r) row[0] = -row[0];
  EXPECT_EQ(check_pose(mirrored, "frame 'b' (b.png)", d), PoseState::refused);
  EXPECT_EQ(d.all().back().text(),
            "frame 'b' (b.png): pose mirrors the scene (determinant -1); flip one camera axis in the export");
  EXPECT_EQ(d.error_count(), 2);
  Pose near = rotated(1.0001);
  EXPECT_EQ(check_pose(near, "frame 'c' (c.png)", d), PoseState::good);
  EXPECT_EQ(d.all().back().severity, Severity::warning);
  EXPECT_EQ(
      d.all().back().text(),
      "frame 'c' (c.png): pose is 0.0002 off orthonormal and was made orthonormal; export poses with more digits");
  const Pose exact = testing_room::room_pose(3);
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) EXPECT_NEAR(near.r[i][j], exact.r[i][j], 1e-12);
  }
}

// Of two axes that lean towards each other each gives way by half, so no axis is trusted more than another.
TEST(SceneChecks, TheNearestRotationIsTaken) {
  constexpr double kLean = 4e-4;
  const Pose exact = testing_room::room_pose(3);
  Pose leaning = exact;
  for (auto& row : leaning.r) row[0] += kLean * row[1];
  Pose pose = leaning;
  Diagnostics d;
  EXPECT_EQ(check_pose(pose, "frame 'a' (a.png)", d), PoseState::good);
  double moved = 0, off = 0;
  for (int a = 0; a < 3; ++a) {
    const Vec3d step = pose.axis(a) - leaning.axis(a);
    moved += dot(step, step);
    for (int b = 0; b < 3; ++b) off = std::max(off, std::abs(dot(pose.axis(a), pose.axis(b)) - (a == b ? 1.0 : 0.0)));
  }
  EXPECT_NEAR(std::sqrt(moved), kLean / std::sqrt(2), 1e-7);
  EXPECT_LT(off, 1e-14);
}

TEST(SceneChecks, NonFinitePosesAreToldAndCounted) {
  Diagnostics d;
  Pose p;
  p.t.y = -std::numeric_limits<double>::infinity();
  EXPECT_EQ(check_pose(p, "x", d), PoseState::not_finite);
  EXPECT_TRUE(d.all().empty());
  report_skipped({"3", "7"}, 8, "traj_w_c.txt", d);
  EXPECT_EQ(d.all().back().text(), "traj_w_c.txt: 2 of 10 frames skipped: their poses are not finite (3, 7)");
  report_skipped({"3"}, 0, "traj_w_c.txt", d);
  EXPECT_EQ(d.all().back().text(), "traj_w_c.txt: all 1 poses are not finite; track the cameras again");
}

TEST(SceneChecks, OpenGlAxesTurn) {
  const Pose p =
      opencv_from_opengl(pose_from_rows(std::vector<double>{1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1}));
  EXPECT_EQ(p.axis(0), (Vec3d{1, 0, 0}));
  EXPECT_EQ(p.axis(1), (Vec3d{0, -1, 0}));
  EXPECT_EQ(p.axis(2), (Vec3d{0, 0, -1}));
  EXPECT_EQ(p.t, (Vec3d{5, 6, 7}));
}

TEST(SceneChecks, Intrinsics) {
  const auto message = [](auto change) {
    Camera c = testing_room::room_camera();
    change(c);
    Diagnostics d;
    const bool good = check_camera(c, "frame 'a'", d) && check_principal_point(c, "frame 'a'", d);
    EXPECT_EQ(good, !d.has_errors());
    return d.all().empty() ? std::string() : d.all().back().text();
  };
  EXPECT_EQ(message([](Camera&) {}), "");
  EXPECT_EQ(
      message([](Camera& c) { c.fx = 0; }),
      "frame 'a': focal length is 0 x 20 pixels; it must be positive; check the intrinsics and the axes convention");
  EXPECT_EQ(
      message([](Camera& c) { c.fy = -3; }),
      "frame 'a': focal length is 20 x -3 pixels; it must be positive; check the intrinsics and the axes convention");
  EXPECT_EQ(message([](Camera& c) { c.cx = 100; }),
            "frame 'a': principal point (100, 15) lies far outside the image of 40 x 30 pixels; check that the "
            "intrinsics belong to images of this size");
  const auto centered = [](double x, double y) { return [x, y](Camera& c) { c.cx = x, c.cy = y; }; };
  const std::string meant =
      " as this one of 40 x 30 pixels: the intrinsics are that image's; state the size that they belong to, or give "
      "those of the images as they are stored";
  EXPECT_EQ(message(centered(80, 60)),
            "frame 'a': principal point (80, 60) is the middle of an image 4 times as large" + meant);
  EXPECT_EQ(message(centered(10, 7.4)),
            "frame 'a': principal point (10, 7.4) is the middle of an image 2.01 times as small" + meant);
  EXPECT_EQ(message(centered(15.2, 19.8)),
            "frame 'a': principal point (15.2, 19.8) is the middle of an image turned by a quarter" + meant);
  EXPECT_EQ(message(centered(26, 14)), "");  // cropped, or a lens that is shifted
  EXPECT_EQ(message([](Camera& c) { c.k2 = std::numeric_limits<double>::quiet_NaN(); }),
            "frame 'a': camera has an intrinsic that is not finite; calibrate again");
  EXPECT_EQ(message([](Camera& c) { c.width_px = 0; }), "frame 'a': image size is 0 x 30; state the size in pixels");
  // r (1 - 0.2 r^2) reaches 0.86 at most: the left and right borders at 1 are lost, top and bottom middles at 0.75 are
  // not.
  EXPECT_EQ(message([](Camera& c) { c.k1 = -0.2; }),
            "frame 'a': lens distortion has no inverse at 6 of 9 points of the image; such pixels are masked; "
            "calibrate with points up to the image corners");
}

}  // namespace
}  // namespace semfield
