// Smooth camera paths, and pose files good and bad.
#include "scene/camera_path.h"

#include <gtest/gtest.h>

#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;
using testing_room::plain_write;

TEST(CameraPath, LookAlongIsLevelAndLooksThere) {
  const Pose p = look_along({1, 2, 3}, {0, 2, 0}, {0, 0, 1});
  EXPECT_EQ(p.axis(2), (Vec3d{0, 1, 0}));
  EXPECT_EQ(p.axis(0), (Vec3d{1, 0, 0}));
  EXPECT_EQ(p.axis(1), (Vec3d{0, 0, -1}));
  const Pose down = look_along({0, 0, 0}, {0, 0, -1}, {0, 0, 1});
  EXPECT_NEAR(length(down.axis(0)), 1, 1e-12);
  EXPECT_NEAR(dot(down.axis(0), down.axis(2)), 0, 1e-12);
}

constexpr double kC = 0.8, kS = 0.6;

std::vector<Pose> read_text(const std::string& text, CameraAxes axes = CameraAxes::right_down_forward) {
  const std::string path = fresh_folder("poses") + "/poses.txt";
  plain_write(path, text);
  return read_camera_file(path, axes);
}

TEST(CameraFile, FourLayoutsGiveTheSamePoses) {
  const std::string a0 = "0.8 -0.6 0 1", a1 = "0.6 0.8 0 2", a2 = "0 0 1 3", last = "0 0 0 1";
  const std::string b0 = "1 0 0 -4", b1 = "0 1 0 5e-1", b2 = "0 0 1 +6";
  for (const std::string& text :
       {a0 + " " + a1 + " " + a2 + " " + last + "\n" + b0 + " " + b1 + " " + b2 + " " + last + "\n",
        a0 + " " + a1 + " " + a2 + "\r\n\r\n# second\r\n" + b0 + "\t" + b1 + " " + b2,
        a0 + "\n" + a1 + "\n" + a2 + "\n" + last + "\n\n" + b0 + "\n" + b1 + "\n" + b2 + "\n" + last + "\n",
        "# 3x4\n" + a0 + "\n" + a1 + "\n" + a2 + "\n\n" + b0 + "\n" + b1 + "\n" + b2 + "\n"}) {
    const std::vector<Pose> poses = read_text(text);
    ASSERT_EQ(poses.size(), 2u) << text;
    EXPECT_NEAR(length(poses[0].axis(0) - Vec3d{kC, kS, 0}), 0, 1e-12);
    EXPECT_NEAR(length(poses[0].axis(1) - Vec3d{-kS, kC, 0}), 0, 1e-12);
    EXPECT_EQ(poses[0].t, (Vec3d{1, 2, 3}));
    EXPECT_EQ(poses[1].t, (Vec3d{-4, 0.5, 6}));
  }
}

TEST(CameraFile, AxesTurnIntoRightDownForward) {
  const std::string text = "1 0 0 0 0 1 0 0 0 0 1 0\n";
  const auto axes = [&](CameraAxes a) {
    const Pose p = read_text(text, a)[0];
    return std::array<Vec3d, 3>{p.axis(0), p.axis(1), p.axis(2)};
  };
  EXPECT_EQ(axes(CameraAxes::right_down_forward), (std::array<Vec3d, 3>{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}));
  EXPECT_EQ(axes(CameraAxes::right_up_backward), (std::array<Vec3d, 3>{{{1, 0, 0}, {0, -1, 0}, {0, 0, -1}}}));
  EXPECT_EQ(axes(CameraAxes::left_up_forward), (std::array<Vec3d, 3>{{{-1, 0, 0}, {0, -1, 0}, {0, 0, 1}}}));
}

TEST(CameraFile, RotationsAreMadeOrthonormal) {
  const Pose p = read_text("0.80003 -0.6 0 0 0.6 0.8 0.0002 0 0 0 1.0004 0\n")[0];
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) EXPECT_NEAR(dot(p.axis(a), p.axis(b)), a == b ? 1 : 0, 1e-14);
  }
}

TEST(CameraFile, BadNumbersNameFileAndLine) {
  const std::string good = "1 0 0 0 0 1 0 0 0 0 1 0\n";
  const std::string layout = "; write one camera-to-world matrix a line, or one matrix row a line";
  const auto numbers = [&](const std::string& line, const std::string& got) {
    return ":" + line + ": expected 4, 12 or 16 numbers, got '" + got + "'" + layout;
  };
  const auto not_finite = [&](const std::string& line, const std::string& word) {
    return ":" + line + ": '" + word +
           "' is not a finite number; write finite numbers, and leave out poses that are lost";
  };
  const std::vector<std::pair<std::string, std::string>> cases{
      {good + "\n1 0 0 0 0 1 0 0 0 0 1\n", numbers("3", "1 0 0 0 0 1 0 0 0 0 1")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 x\n", not_finite("2", "x")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 nan\n", not_finite("2", "nan")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 inf\n", not_finite("2", "inf")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 1e999\n", not_finite("2", "1e999")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 0 -\n", not_finite("2", "-")},
      {good + "1 0 0 0 0 1 0 0 0 0 1 0 5e\n", not_finite("2", "5e")},
      {"90\n" + good, numbers("1", "90")},
      {good + "2 0 0 0 0 2 0 0 0 0 2 0\n", ":2: the 3x3 part is no rotation; give camera-to-world matrices"},
      {good + "-1 0 0 0 0 1 0 0 0 0 1 0\n", ":2: the 3x3 part is no rotation; give camera-to-world matrices"},
      {"1 0 0 0 0 1 0 0 0 0 1 0 3 2 1 1\n",
       ":1: the last row is not 0 0 0 1; give camera-to-world matrices, row by row"},
      {good + "1 0 0 0\n", ":2: expected 12 or 16 numbers a pose; write all poses of a file in the same form"},
      {"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0\n", ": 5 lines are no multiple of 4; the file was cut short"},
      {"", ": holds no pose; write one camera-to-world matrix a line"},
      {"# nothing\n\n", ": holds no pose; write one camera-to-world matrix a line"},
  };
  const std::string path = fresh_folder("bad") + "/poses.txt";
  for (const auto& [text, message] : cases) {
    plain_write(path, text);
    EXPECT_EQ(error_of([&] { read_camera_file(path, CameraAxes::right_down_forward); }), path + message) << text;
  }
}

TEST(SmoothPath, MeetsItsKeysAndTurnsLittleFromFrameToFrame) {
  // Turns about every axis, half turns among them: each of the four ways to a quaternion is taken.
  std::vector<Pose> keys;
  for (const Vec3d forward : {Vec3d{1, 0, 0}, {0, 1, 0.2}, {-1, 0.3, 0}, {-0.2, -1, 0.4}, {0.9, -0.1, -0.3}}) {
    keys.push_back(look_along(forward * 2.0, forward, {0, 0, 1}));
  }
  for (const Vec3d axis : {Vec3d{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}) {
    Pose half;  // 2 a a^T - 1
    for (int row = 0; row < 3; ++row) {
      for (int col = 0; col < 3; ++col) {
        half.r[static_cast<std::size_t>(row)][static_cast<std::size_t>(col)] =
            2 * axis[row] * axis[col] - (row == col ? 1 : 0);
      }
    }
    keys.push_back(half);
  }
  const int between = 50, count = between * static_cast<int>(keys.size() - 1) + 1;
  const std::vector<Pose> path = make_smooth_path(keys, count);
  ASSERT_EQ(path.size(), static_cast<std::size_t>(count));
  for (std::size_t k = 0; k < keys.size(); ++k) {
    const Pose& met = path[k * between];
    for (int axis = 0; axis < 3; ++axis) EXPECT_LT(length(met.axis(axis) - keys[k].axis(axis)), 1e-9) << k;
    EXPECT_LT(length(met.t - keys[k].t), 1e-9) << k;
  }
  for (std::size_t i = 0; i < path.size(); ++i) {
    EXPECT_NEAR(dot(cross(path[i].axis(0), path[i].axis(1)), path[i].axis(2)), 1, 1e-9);
    if (i == 0) continue;
    EXPECT_GT(dot(path[i].axis(2), path[i - 1].axis(2)), std::cos(0.2)) << i;
    EXPECT_LT(length(path[i].t - path[i - 1].t), 0.2) << i;
  }
  EXPECT_EQ(make_smooth_path({keys[0]}, 3).size(), 3U);
}

}  // namespace
}  // namespace semfield
