// Poses and cameras before they are believed, and the bounds that a scene gets.
#include "scene/scene_checks.h"

#include <algorithm>

#include "loading/frame_source.h"
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
  EXPECT_HAS(d.all().back().text(), "frame 'a' (a.png)", "0.002 off orthonormal", "1e-3", "without a scale");
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

// A lens that puts the whole image on one spot, or most of it nowhere.
TEST(SceneChecks, LensesThatNoCameraHasAreNamed) {
  const auto said = [](LensKind lens, double Camera::*coefficient, double value) {
    Camera c = testing_room::room_camera();
    c.lens = lens;
    c.*coefficient = value;
    Diagnostics d;
    const bool good = check_camera(c, "frame 'a'", d);
    EXPECT_EQ(good, !d.has_errors());
    return d.all().empty() ? std::string("nothing") : d.all().back().shown();
  };
  using C = Camera;
  for (const auto& [lens, coefficient, value] :
       std::vector<std::tuple<LensKind, double C::*, double>>{{LensKind::perspective, &C::k1, 1e9},
                                                              {LensKind::perspective, &C::k4, 1e12},
                                                              {LensKind::perspective, &C::k1, 1e300},
                                                              {LensKind::perspective, &C::k1, -1e9},
                                                              {LensKind::perspective, &C::p1, 1e9},
                                                              {LensKind::perspective, &C::p2, -1e300},
                                                              {LensKind::fisheye, &C::k1, 1e9},
                                                              {LensKind::fisheye, &C::k1, 1e300},
                                                              {LensKind::fisheye, &C::k3, -1e300},
                                                              {LensKind::fisheye, &C::k1, -1e9}})
    EXPECT_HAS(said(lens, coefficient, value), "[scene.camera.distortion]") << value;
  EXPECT_HAS(said(LensKind::perspective, &C::k1, 20), "[scene.camera.bent]", "times their angle");
  for (const double usual : {-0.05, 0.15, 0.4}) {
    EXPECT_EQ(said(LensKind::perspective, &C::k1, usual), "nothing") << usual;
    EXPECT_EQ(said(LensKind::fisheye, &C::k1, usual), "nothing") << usual;
  }
  EXPECT_EQ(said(LensKind::fisheye, &C::k1, -0.5), "nothing") << "a circle in the middle of the image";
}

TEST(SceneChecks, FramesOfOnePoseAreNamed) {
  const auto said = [](const std::vector<int>& poses) {
    SceneInfo info{.name = "room"};
    for (const int i : poses)
      info.frames.push_back(
          {.name = "f" + std::to_string(info.frames.size()), .world_from_camera = testing_room::room_pose(i)});
    Diagnostics d;
    check_poses_differ(info, d);
    return d.all().empty() ? std::string("nothing") : d.all()[0].shown();
  };
  EXPECT_EQ(said({0, 1, 2, 3}), "nothing");
  EXPECT_EQ(said({0}), "nothing");
  EXPECT_HAS(said(std::vector<int>(12, 3)), "room", "all 12 frames have one pose", "[scene.pose.repeated]");
  EXPECT_HAS(said({0, 1, 2, 2, 2, 0}), "5 of 6 frames", "3 that of 'f2'", "[scene.pose.repeated]");
}

// Bounds of scenes without depth: around an object before one colour, inside the file's own limit, and the cameras'
// rig.

Pose look_at(Vec3d eye, Vec3d target) {
  const Vec3d z = normalized(target - eye), x = normalized(cross(z, Vec3d{0.01, 1, 0.02})), y = cross(z, x);
  Pose pose;
  for (std::size_t row = 0; row < 3; ++row) {
    const auto r = static_cast<int>(row);
    pose.r[row] = {x[r], y[r], z[r]};
  }
  pose.t = eye;
  return pose;
}

FrameInfo frame_at(Vec3d eye, Vec3d target, double fov_deg = 40) {
  FrameInfo frame{.camera = {.width_px = 48, .height_px = 48}};
  frame.camera.fx = frame.camera.fy = 24 / std::tan(fov_deg * M_PI / 360);
  frame.camera.cx = frame.camera.cy = 24;
  frame.world_from_camera = look_at(eye, target);
  return frame;
}

// Spread over the upper half of a sphere about `center`.
Vec3d on_dome(int i, int count, double radius, Vec3d center) {
  const double height = 0.05 + 0.9 * i / count, around = 2.399963 * i, flat = std::sqrt(1 - height * height);
  return center + Vec3d{flat * std::cos(around), height, flat * std::sin(around)} * radius;
}

// Frames of an ellipsoid with a highlight, before one colour, seen from a dome.
struct ObjectDataset {
  Vec3d center{1, 0.4, -2}, half{1.3, 0.4, 0.7};
  std::array<std::uint8_t, 3> background{255, 255, 255};
  double radius = 4;
  Box limit;
  bool noisy_background = false;

  SceneInfo open(Diagnostics&) const {
    SceneInfo info{.name = "object", .limit = limit};
    for (int i = 0; i < 40; ++i) {
      info.frames.push_back(frame_at(on_dome(i, 40, radius, center), center));
      info.frames.back().name = std::to_string(i);
      info.frames.back().split = i % 8 == 0 ? Split::test : Split::train;
    }
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    Diagnostics unused;
    const FrameInfo frame = open(unused).frames[i];
    out = {};
    out.width_px = frame.camera.width_px;
    out.height_px = frame.camera.height_px;
    for (int y = 0; y < out.height_px; ++y) {
      for (int x = 0; x < out.width_px; ++x) {
        const Vec3d d = frame.world_from_camera.rotate(frame.camera.direction(x + 0.5, y + 0.5));
        Vec3d o = frame.world_from_camera.t - center;
        double a = 0, b = 0, c = -1;
        for (int k = 0; k < 3; ++k) {
          a += d[k] * d[k] / half[k] / half[k];
          b += 2 * o[k] * d[k] / half[k] / half[k];
          c += o[k] * o[k] / half[k] / half[k];
        }
        const bool hit = b * b - 4 * a * c > 0;
        const bool highlight = hit && (x + y + i) % 11 == 0;  // as bright as the background
        for (std::size_t k = 0; k < 3; ++k) {
          const int noise = noisy_background ? (x * 37 + y * 91 + i * 53) % 160 : 0;
          out.rgb.push_back(hit && !highlight ? static_cast<std::uint8_t>(90 + 20 * k)
                                              : static_cast<std::uint8_t>(std::abs(background[k] - noise)));
        }
      }
    }
  }
};

class PlainColors : public ::testing::TestWithParam<int> {};
INSTANTIATE_TEST_SUITE_P(SceneBounds, PlainColors, ::testing::Values(255, 0, 200),
                         [](const auto& level) { return "level_" + std::to_string(level.param); });

TEST_P(PlainColors, BoundsAreTheBoxOfTheSilhouettes) {
  ObjectDataset object;
  object.background.fill(static_cast<std::uint8_t>(GetParam()));
  Diagnostics d;
  const LoadedScene s = load_scene(object, {}, d);
  EXPECT_TRUE(d.all().empty());
  EXPECT_EQ(s.bounds_from, "the object's silhouettes in 35 training frames");
  EXPECT_EQ(s.near_far_from, "the object's silhouettes");
  ASSERT_TRUE(s.plain_background.has_value());
  EXPECT_EQ(s.plain_background->color[0], GetParam());
  EXPECT_FALSE(s.extent_is_guessed);
  for (int a = 0; a < 3; ++a) {
    EXPECT_LE(s.bounds.lo[a], object.center[a] - object.half[a]) << a;
    EXPECT_GE(s.bounds.hi[a], object.center[a] + object.half[a]) << a;
    EXPECT_GT(s.bounds.lo[a], object.center[a] - object.half[a] - 0.4) << a;
    EXPECT_LT(s.bounds.hi[a], object.center[a] + object.half[a] + 0.4) << a;
  }
  EXPECT_GT(s.near_m, 1.5);
  EXPECT_LT(s.near_m, 4 - 1.3);
  EXPECT_GT(s.far_m, 4 + 1.3);
  EXPECT_LT(s.far_m, 8);
}

TEST(SceneBounds, OtherBackgroundsLeaveTheViewCones) {
  ObjectDataset object{.noisy_background = true};
  Diagnostics d;
  const LoadedScene s = load_scene(object, {}, d);
  EXPECT_FALSE(s.plain_background.has_value());
  EXPECT_TRUE(s.rig.inward);
  EXPECT_TRUE(s.extent_is_guessed);
  EXPECT_EQ(s.bounds_from, "the view cones of 35 training cameras up to far");
}

TEST(SceneBounds, TheFilesLimitCutsTheCones) {
  ObjectDataset object{.limit = {{-3, -3, -3}, {3, 3, 3}}, .noisy_background = true};
  Diagnostics d;
  const LoadedScene s = load_scene(object, {}, d);
  EXPECT_EQ(s.bounds.lo, object.limit.lo);
  EXPECT_EQ(s.bounds.hi, object.limit.hi);
  EXPECT_HAS(s.bounds_from, "aabb_scale");
  object.limit = {{100, 100, 100}, {103, 103, 103}};  // of other poses
  EXPECT_EQ(load_scene(object, {}, d).bounds_from, "the view cones of 35 training cameras up to far");
}

// Far is as good as infinity there: a pixel is measured where the bounds are, also where cameras look outward.
TEST(SceneBounds, APixelOfContractedSpaceIsThatOfTheBounds) {
  struct Outward : ObjectDataset {
    SceneInfo open(Diagnostics& d) const {
      SceneInfo info = ObjectDataset::open(d);
      for (FrameInfo& frame : info.frames)
        frame = frame_at(frame.world_from_camera.t, frame.world_from_camera.t * 2 - center);
      for (std::size_t i = 0; i < info.frames.size(); ++i) {
        info.frames[i].name = std::to_string(i);
        info.frames[i].split = i % 8 == 0 ? Split::test : Split::train;
      }
      return info;
    }
  } outward;
  SceneLoadOptions options{.check_geometry = false, .contracted = true};
  Diagnostics d;
  const LoadedScene s = load_scene(outward, options, d);
  const Vec3d size = s.bounds.size();
  const double longest = std::max({size.x, size.y, size.z});
  EXPECT_GT(s.far_m, 20 * longest);
  EXPECT_NEAR(s.pixel_footprint_m, 0.5 * longest / s.info.frames[0].camera.fx, 1e-7);  // a median in float
}

TEST(SceneBounds, TheConfigurationIsTrustedMost) {
  const ObjectDataset object;
  SceneLoadOptions options{.bounds = {-1, -2, -3, 1, 2, 3}};
  Diagnostics d;
  const LoadedScene s = load_scene(object, options, d);
  EXPECT_EQ(s.bounds.hi, (Vec3d{1, 2, 3}));
  EXPECT_EQ(s.bounds_from, "the configuration");
}

CameraRig rig_of(const std::vector<FrameInfo>& frames) {
  Cameras cameras;
  for (const FrameInfo& frame : frames) cameras.push_back(&frame);
  return find_rig(cameras);
}

TEST(CameraRig, ADomeOfCamerasLooksInward) {
  std::vector<FrameInfo> frames;
  const Vec3d center{10, -3, 5};
  for (int i = 0; i < 60; ++i) frames.push_back(frame_at(on_dome(i, 60, 4, center), center));
  frames.push_back(frame_at(center + Vec3d{30, 2, 0}, center + Vec3d{60, 0, 40}));  // a stray one looks away
  const CameraRig rig = rig_of(frames);
  ASSERT_TRUE(rig.inward);
  EXPECT_LT(length(rig.focus - center), 0.05);
  EXPECT_NEAR(rig.distance_m, 4, 0.05);
  for (int a = 0; a < 3; ++a) {  // the ball in all cones has the radius 4 sin(20 degrees)
    EXPECT_LT(rig.seen.lo[a], center[a] - 1.2);
    EXPECT_GT(rig.seen.hi[a], center[a] + 1.2);
    EXPECT_GT(rig.seen.lo[a], center[a] - 3.0);
    EXPECT_LT(rig.seen.hi[a], center[a] + 3.0);
  }
}

TEST(CameraRig, OtherRigsDoNot) {
  std::vector<FrameInfo> panorama, walk, one_side, outward, parallel;
  for (int i = 0; i < 24; ++i) {
    const double a = 2 * M_PI * i / 24;
    const Vec3d way{std::cos(a), 0.1 * std::sin(3 * a), std::sin(a)};
    panorama.push_back(frame_at({1, 1, 1}, Vec3d{1, 1, 1} + way));
    outward.push_back(frame_at(way * 2, way * 5));
    walk.push_back(frame_at({0.3 * i, 0, 0.1 * std::sin(a)}, Vec3d{0.3 * i, 0, 0} + way));
    one_side.push_back(frame_at({0.1 * i - 1.2, 0.2 * std::sin(a), -5}, {0, 0, 0}));
    parallel.push_back(frame_at({0.1 * i, 0, 0}, {0.1 * i, 0, 9}));
  }
  for (const auto* frames : {&panorama, &walk, &one_side, &outward, &parallel}) {
    EXPECT_FALSE(rig_of(*frames).inward) << frames - &panorama;
    EXPECT_TRUE(rig_of(*frames).seen.empty());
  }
  EXPECT_FALSE(rig_of({}).inward);
}

}  // namespace
}  // namespace semfield
