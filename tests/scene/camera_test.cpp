// Cameras: pixel centres, lens and its inverse, resizing; files of cameras, and paths of them.
#include "scene/camera.h"

#include <algorithm>
#include <sstream>

#include "scene/camera_path.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

Camera lens_camera() {
  return Camera{.width_px = 640, .height_px = 480, .fx = 500, .fy = 510, .cx = 322.5, .cy = 236.25};
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
  Camera c{.width_px = 2, .height_px = 2, .fx = 1, .fy = 1, .k1 = 0.1, .k4 = 0.01, .p1 = 0.02, .p2 = 0.03};
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

Camera fisheye_camera() {
  Camera c = lens_camera();
  c.lens = LensKind::fisheye;
  c.fx = 190;
  c.fy = 188;
  c.k1 = -0.021;
  c.k2 = 0.0043;
  c.k3 = -0.0021;
  c.k4 = 0.00031;
  return c;
}
Camera panorama_camera() {
  Camera c = lens_camera();
  c.lens = LensKind::equirectangular;
  c.fx = c.width_px / (2 * M_PI);
  c.fy = c.height_px / M_PI;
  c.cx = 0.5 * c.width_px;
  c.cy = 0.5 * c.height_px;
  return c;
}

// The formulas of OpenCV's documentation of its fisheye model, on their own: a = x / z, b = y / z, r^2 = a^2 + b^2,
// theta = atan(r), theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), x' = (theta_d / r) a.
TEST(Camera, AFisheyeProjectsAsOpenCvSays) {
  const Camera c = fisheye_camera();
  for (const Vec3d p : {Vec3d{0.3, -0.2, 1}, Vec3d{-2, 0.7, 0.9}, Vec3d{1e-4, 2e-5, 3}, Vec3d{5, 4, 0.1}}) {
    const double a = p.x / p.z, b = p.y / p.z, r = std::sqrt(a * a + b * b), t = std::atan(r);
    const double td =
        t * (1 + c.k1 * std::pow(t, 2) + c.k2 * std::pow(t, 4) + c.k3 * std::pow(t, 6) + c.k4 * std::pow(t, 8));
    double u = 0, v = 0;
    ASSERT_TRUE(c.sees(p));
    c.project(p, u, v);
    EXPECT_NEAR(u, c.fx * td / r * a + c.cx, 1e-10);
    EXPECT_NEAR(v, c.fy * td / r * b + c.cy, 1e-10);
  }
}

TEST(Camera, PixelsOfWideLensesComeBack) {
  double worst = 0;
  for (const Camera& c : {fisheye_camera(), panorama_camera()}) {
    int rays = 0;
    for (int y = 0; y < c.height_px; y += 7) {
      for (int x = 0; x < c.width_px; x += 7) {
        const Vec3d d = c.direction(x + 0.5, y + 0.5);
        if (d == Vec3d{0, 0, 0}) continue;
        ++rays;
        EXPECT_NEAR(length(d), 1, 1e-15);
        EXPECT_NEAR(c.depth_of(d * 3.0), 3, 1e-14) << "depth is the distance";
        double u = 0, v = 0;
        ASSERT_TRUE(c.sees(d * 3.7));
        c.project(d * 3.7, u, v);
        worst = std::max({worst, std::abs(u - x - 0.5), std::abs(v - y - 0.5)});
      }
    }
    EXPECT_EQ(rays, 92 * 69) << "every pixel has a ray";
  }
  EXPECT_LE(worst, 1e-9);
  std::ostringstream shown;
  shown << worst;
  RecordProperty("roundtrip_px", shown.str());
}

TEST(Camera, AFisheyeSeesBehindItselfAndNotBeyondItsFold) {
  Camera c = fisheye_camera();
  c.k1 = c.k2 = c.k3 = c.k4 = 0;
  EXPECT_LT(c.direction(c.cx + 1.7 * c.fx, c.cy).z, 0) << "1.7 radians off the axis";
  EXPECT_EQ(c.direction(c.cx + 3.2 * c.fx, c.cy), (Vec3d{0, 0, 0})) << "more than all around";
  EXPECT_EQ(c.direction(c.cx, c.cy), (Vec3d{0, 0, 1}));
  c.k1 = -0.2;  // theta (1 - 0.2 theta^2) grows up to 1.29, where it is 0.861
  EXPECT_EQ(c.direction(c.cx + 0.87 * c.fx, c.cy), (Vec3d{0, 0, 0}));
  EXPECT_NEAR(std::acos(c.direction(c.cx + 0.85 * c.fx, c.cy).z), 1.18, 0.05);
  EXPECT_FALSE(c.sees({0, 3, -1}));
  EXPECT_TRUE(c.sees({0, 3, 1}));
}

TEST(Camera, APanoramaHasForwardInItsMiddleAndRightToTheRight) {
  const Camera c = panorama_camera();
  const auto is = [&](double u, double v, Vec3d d) {
    EXPECT_LT(length(c.direction(u, v) - d), 1e-15) << u << ' ' << v;
  };
  is(320, 240, {0, 0, 1});
  is(480, 240, {1, 0, 0});
  is(160, 240, {-1, 0, 0});
  is(0, 240, {0, 0, -1});
  is(320, 0, {0, -1, 0});
  is(320, 480, {0, 1, 0});
  EXPECT_EQ(c.direction(320, 481), (Vec3d{0, 0, 0}));
  Camera turned = c;
  turned.cx = 100;  // forward lies elsewhere; what leaves the image at one side comes in at the other
  double u = 0, v = 0;
  turned.project(turned.direction(600.5, 30.5), u, v);
  EXPECT_NEAR(u, 600.5, 1e-9);
  EXPECT_NEAR(v, 30.5, 1e-9);
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

// Cameras as a file: what was written is read to the bit, and what cannot be a camera is refused by its number.

CameraSet two_cameras() {
  CameraSet set;
  const Pose pose = look_along({1.0 / 3, -2e-7, 1e5 / 7}, {0.3, 0.7, -0.1}, {0, 0, 1});
  set.cameras.push_back({"rgb/0001",
                         {640, 480, 500.1, 501.0 / 3, 320.5, 239.7, 0.1, -0.02, 1e-3, 2e-4, 3e-5, -1e-5},
                         pose,
                         0.1,
                         20.0 / 3});
  set.cameras.push_back({"a \"b\" \xC3\xA4", {8, 6, 8, 8, 4, 3}, {}, 0, 0});
  return set;
}

TEST(CameraSet, IsReadBackToTheBit) {
  const std::string path = fresh_folder("cameras") + "/cameras.json";
  for (const bool z_depth : {false, true}) {
    CameraSet set = two_cameras();
    set.z_depth = z_depth;
    if (z_depth) set.cameras[1].camera.lens = LensKind::fisheye;
    write_cameras(path, set);
    EXPECT_TRUE(is_camera_set(path));
    Diagnostics diagnostics;
    const CameraSet read = read_cameras(path, diagnostics);
    EXPECT_TRUE(diagnostics.all().empty());
    EXPECT_EQ(read.z_depth, z_depth);
    ASSERT_EQ(read.cameras.size(), 2U);
    for (std::size_t i = 0; i < 2; ++i) {
      const PlacedCamera &a = set.cameras[i], &b = read.cameras[i];
      const Camera &c = a.camera, &d = b.camera;
      EXPECT_EQ(a.name, b.name);
      EXPECT_EQ((std::array{c.width_px, c.height_px}), (std::array{d.width_px, d.height_px}));
      EXPECT_EQ((std::array{c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2}),
                (std::array{d.fx, d.fy, d.cx, d.cy, d.k1, d.k2, d.k3, d.k4, d.p1, d.p2}));
      EXPECT_EQ(c.lens, d.lens);
      EXPECT_EQ(a.world_from_camera.r, b.world_from_camera.r);
      EXPECT_EQ(a.world_from_camera.t, b.world_from_camera.t);
      EXPECT_EQ((std::array{a.near_m, a.far_m}), (std::array{b.near_m, b.far_m}));
    }
    const std::string first = read_text_file(path);
    write_cameras(path, read);
    EXPECT_EQ(read_text_file(path), first);
  }
}

TEST(CameraSet, RowsOfNumbersAreNone) {
  const std::string path = fresh_folder("rows") + "/path.txt";
  plain_write(path, "# first\n1 0 0 0 0 1 0 0 0 0 1 0\n");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "\r\n\t {}");
  EXPECT_TRUE(is_camera_set(path));
}

TEST(CameraSet, WhatIsNoCameraIsNamedByFileAndNumber) {
  const std::string path = fresh_folder("bad") + "/cameras.json";
  write_cameras(path, two_cameras());
  const std::string good = read_text_file(path);
  const auto error_with = [&](const std::string& old, const std::string& text) {
    std::string changed = good;
    const std::size_t at = changed.rfind(old);
    EXPECT_NE(at, std::string::npos) << old;
    plain_write(path, changed.replace(at, old.size(), text));
    return error_of([&] {
      Diagnostics diagnostics;
      (void)read_cameras(path, diagnostics);
    });
  };
  const std::string whole =
      "; give a cameras.json as `semfield render` writes it, or a text file with a camera-to-world matrix a line";
  EXPECT_EQ(error_with("semfield-cameras-1", "nerfstudio"),
            path + ": its 'format' is not 'semfield-cameras-1'" + whole);
  EXPECT_EQ(error_with("distance along the ray", "metres"),
            path + ": its 'near_far' is neither 'distance along the ray' nor 'z-depth'" + whole);
  EXPECT_EQ(error_with("\"cameras\"", "\"frames\""), path + ": it has no list 'cameras' with a camera in it" + whole);
  EXPECT_EQ(error_with("]\n}\n", "").find(path + ": not valid JSON: parse error at line 8"), 0U);
  EXPECT_EQ(error_with("\"k1\":0.0", "\"k1\":1e999").find(path + ": not valid JSON: "), 0U);
  const std::string second = "the cameras have problems:\n" + path + ": camera 1: ";
  const std::pair<std::string, std::string> cases[][2] = {
      {{"\"fx\":8.0", "\"fx\":-8"}, {"", "focal length"}},
      {{"\"fx\":8.0", "\"fx\":\"8\""}, {"", "'fx' is not a number; write a number"}},
      {{"\"fx\":8.0,", ""}, {"", "'fx' is missing; write a number"}},
      {{"\"k1\":0.0", "\"kl\":0.0"}, {"", "unknown key 'kl'; did you mean 'k1'?"}},
      {{"\"width\":8", "\"width\":8.5"}, {"", "'width' x 'height' is not a pair of whole numbers of pixels"}},
      {{"\"width\":8", "\"width\":1e9"}, {"", "limits.image_axis_px"}},
      {{"\"fx\":8.0", "\"lens\":\"fish\",\"fx\":8.0"},
       {"", "'lens' is none of perspective, fisheye and equirectangular"}},
      {{"[0,0,0,1]", "[0,0,1]"}, {"", "'world_from_camera' is not a list of 4 rows of 4 numbers"}},
      {{"[0,0,0,1]", "[0,0,1,1]"}, {"", "the last row of the pose is not 0 0 0 1"}},
      {{"[1.0,0.0,0.0,0.0]", "[2.0,0.0,0.0,0.0]"}, {"", "pose is not a rotation"}},
      {{"[1.0,0.0,0.0,0.0]", "[-1.0,0.0,0.0,0.0]"}, {"", "pose mirrors the scene"}},
      {{"\"p2\":0.0", "\"p2\":0.0,\"near\":2,\"far\":2"},
       {"", "'near' and 'far' are not distances with 0 <= near < far"}},
      {{"\"p2\":0.0", "\"p2\":0.0,\"near\":2"}, {"", "'far' is missing"}},
      {{"a \\\"b\\\" \xC3\xA4", ""}, {"", "its name is empty"}},
      {{"a \\\"b\\\" \xC3\xA4", "a\\nb"}, {"", "its name has a control character"}},
      {{"a \\\"b\\\" \xC3\xA4", "rgb_0001"}, {"", "its files would be called 'rgb_0001', as those of 'rgb/0001'"}},
  };
  for (const auto& [change, said] : cases) {
    const std::string error = error_with(change.first, change.second);
    EXPECT_EQ(error.find(second), 0U) << error;
    EXPECT_HAS(error, said.second);
  }
}

// Smooth camera paths, and pose files good and bad.

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
      {good + "2 0 0 0 0 2 0 0 0 0 2 0\n", ":2: the 3x3 part is not a rotation; give camera-to-world matrices"},
      {good + "-1 0 0 0 0 1 0 0 0 0 1 0\n", ":2: the 3x3 part is not a rotation; give camera-to-world matrices"},
      {"1 0 0 0 0 1 0 0 0 0 1 0 3 2 1 1\n",
       ":1: the last row is not 0 0 0 1; give camera-to-world matrices, row by row"},
      {good + "1 0 0 0\n", ":2: expected 12 or 16 numbers a pose; write all poses of a file in the same form"},
      {"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0\n", ": 5 lines are not a multiple of 4; the file was cut short"},
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
  for (const Vec3d forward : {Vec3d{1, 0, 0}, {0, 1, 0.2}, {-1, 0.3, 0}, {-0.2, -1, 0.4}, {0.9, -0.1, -0.3}})
    keys.push_back(look_along(forward * 2.0, forward, {0, 0, 1}));
  for (const Vec3d axis : {Vec3d{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}) {
    Pose half;  // 2 a a^T - 1
    for (int row = 0; row < 3; ++row) {
      for (int col = 0; col < 3; ++col) half.r[row][col] = 2 * axis[row] * axis[col] - (row == col ? 1 : 0);
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
