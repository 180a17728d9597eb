// Poses against pixels: every convention is named from depth and from photographs, and right scenes are left in peace.
#include "scene/survey/geometry_survey.h"

#include <algorithm>

#include "compute/parallel.h"
#include "loading/frame_source.h"
#include "scene/scene_checks.h"
#include "scene/survey/bundle.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

std::uint32_t hashed(std::uint32_t v) {
  v = (v ^ (v >> 16)) * 0x45d9f3bu;
  v = (v ^ (v >> 16)) * 0x45d9f3bu;
  return v ^ (v >> 16);
}

// The box room with walls of random grey patches of 8 centimetres, seen from `poses` and written as `written` says.
struct Room {
  std::vector<Pose> poses;
  std::function<Pose(const Pose&)> written = [](const Pose& p) { return p; };
  std::function<void(int, FrameBuffer&)> spoiled = [](int, FrameBuffer&) {};
  bool depth = true, texture = true, opengl_files = false;
  int width = 160, height = 120;
  double focal = 1;      // what multiplies the focal lengths as they are written
  bool fisheye = false;  // of 140 degrees

  Camera camera() const {
    Camera out = room_camera(width, height);
    if (!fisheye) return out;
    out.lens = LensKind::fisheye;
    out.fx = out.fy = 0.5 * width / 1.22;
    return out;
  }

  SceneInfo open(Diagnostics&) const {
    SceneInfo info{.name = "room", .opengl_files = opengl_files};
    for (std::size_t i = 0; i < poses.size(); ++i) {
      FrameInfo f{.name = std::to_string(i), .camera = camera()};
      f.camera.fx *= focal;
      f.camera.fy *= focal;
      f.world_from_camera = written(poses[i]);
      f.has_depth = depth;
      info.frames.push_back(f);
    }
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    const Pose& pose = poses[i];
    const Camera lens = camera();
    out = {};
    out.width_px = width;
    out.height_px = height;
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        const Vec3d d = lens.direction(x + 0.5, y + 0.5);
        const Hit hit = trace(pose.t, pose.rotate(d));
        const Vec3d p = pose.t + pose.rotate(d) * hit.t;
        std::uint32_t cell = static_cast<std::uint32_t>(hit.wall);
        for (int a = 0; a < 3; ++a)
          cell = hashed(cell * 1000 + static_cast<std::uint32_t>(std::floor(p[a] / 0.08 + 0.5) + 100));
        const auto grey = static_cast<std::uint8_t>(texture ? cell % 256 : 100);
        out.rgb.insert(out.rgb.end(), {grey, grey, grey});
        if (depth) out.depth_m.push_back(static_cast<float>(hit.t * d.z));
      }
    }
    spoiled(i, out);
  }
};

// A walk around the middle of the room that looks about, tilted a little.
std::vector<Pose> walk(int frames, double turn = 0.2, double radius = 0.7) {
  std::vector<Pose> out;
  for (int i = 0; i < frames; ++i) {
    const double a = turn * i, tilt = 0.2 * std::sin(1.3 * i);
    const Pose yaw{{{{std::cos(a), 0, std::sin(a)}, {0, 1, 0}, {-std::sin(a), 0, std::cos(a)}}}, {}};
    const Pose pitch{{{{1, 0, 0}, {0, std::cos(tilt), -std::sin(tilt)}, {0, std::sin(tilt), std::cos(tilt)}}}, {}};
    Pose p;
    for (int col = 0; col < 3; ++col) {
      const Vec3d axis = yaw.rotate(pitch.axis(col));
      for (int row = 0; row < 3; ++row) p.r[row][col] = axis[row];
    }
    p.t = {radius * std::cos(0.5 * a), 0.2 * std::sin(0.9 * i), radius * std::sin(0.7 * a)};
    out.push_back(p);
  }
  return out;
}

Pose inverse(const Pose& p) {
  Pose out;
  for (std::size_t r = 0; r < 3; ++r) {
    for (std::size_t c = 0; c < 3; ++c) out.r[r][c] = p.r[c][r];
  }
  out.t = p.unrotate(p.t) * -1.0;
  return out;
}
Pose times(Pose p, double by) {
  p.t = p.t * by;
  return p;
}

struct Answer {
  std::string geometry, error, warning;
};
Answer ask(const Room& room, const SceneLoadOptions& options = {}) {
  Diagnostics d;
  Answer out{.geometry = load_scene(room, options, d).geometry};
  for (const Diagnostic& x : d.all()) {
    if (x.where != "room") continue;
    (x.severity == Severity::error ? out.error : out.warning) += x.text();
  }
  return out;
}

void expect_quiet(const Answer& a, const std::string& says) {
  EXPECT_EQ(a.error + a.warning, "");
  EXPECT_HAS(a.geometry, says);
}

TEST(GeometrySurvey, RightScenesOfEveryKindAreLeftInPeace) {
  Room room{.poses = walk(24)};
  expect_quiet(ask(room), "poses agree with depth");
  Room shuffled = room;  // files in any order
  for (std::size_t i = 0; i < 24; ++i) shuffled.poses[i] = room.poses[i * 7 % 24];
  expect_quiet(ask(shuffled), "poses agree with depth");
  Room wide{.poses = walk(8, 0.6)};
  expect_quiet(ask(wide), "poses agree with depth");
  Room film{.poses = walk(200, 0.01)};
  film.width = 40;
  film.height = 30;
  expect_quiet(ask(film), "poses agree with depth");
  Room opengl = room;
  opengl.opengl_files = true;
  expect_quiet(ask(opengl), "poses agree with depth");
}

TEST(GeometrySurvey, NoiseHolesAndThingsThatMoveRaiseNoAlarm) {
  Room room{.poses = walk(24)};
  room.spoiled = [](int frame, FrameBuffer& f) {
    for (std::size_t i = 0; i < f.depth_m.size(); ++i) {
      const auto random = hashed(static_cast<std::uint32_t>(frame) * 100000u + static_cast<std::uint32_t>(i));
      const int x = static_cast<int>(i) % f.width_px, y = static_cast<int>(i) / f.width_px;
      f.depth_m[i] *= 1 + 0.02f * (static_cast<float>(random % 1000) / 500 - 1);  // a sensor's noise
      if (x / 8 % 2 == 0 && y > 20) f.depth_m[i] = 0;                             // and its holes
      if (y < 24) f.depth_m[i] = 0.3f;                                            // a gripper before the camera
    }
  };
  expect_quiet(ask(room), "poses agree with depth");
}

TEST(GeometrySurvey, WhatCannotBeSeenIsNotClaimed) {
  Room still{.poses = std::vector<Pose>(12, walk(5)[4])};
  const Answer one_pose = ask(still);
  EXPECT_HAS(one_pose.geometry, "could not be checked: the camera hardly moves");
  EXPECT_EQ(one_pose.error, "");
  EXPECT_HAS(one_pose.warning, "all 12 frames have one pose");
  Room turning{.poses = walk(24, 0.2, 0)};  // on one spot: no unit shows
  for (Pose& p : turning.poses) p.t = {0.3, 0.1, -0.2};
  expect_quiet(ask(turning), "poses agree with depth");
  Room millimetres = turning;
  millimetres.written = [](const Pose& p) { return times(p, 1000); };
  expect_quiet(ask(millimetres), "poses agree with depth");
  Room apart{.poses = {walk(1)[0], walk(12, 0.26)[11]}};  // two views that share nothing
  expect_quiet(ask(apart), "could not be checked: no two frames look in a similar direction");
  Room empty{.poses = walk(2)};
  empty.spoiled = [](int frame, FrameBuffer& f) { f.depth_m.assign(f.depth_m.size(), frame == 0 ? 2.0f : 0.0f); };
  expect_quiet(ask(empty), "could not be checked: no two frames with depth overlap");
  Room one{.poses = walk(1)};
  expect_quiet(ask(one), "could not be checked");
  Room jitter{.poses = std::vector<Pose>(12, walk(5)[4])};  // a tripod, tracked with errors of 5 mm: no unit is claimed
  jitter.written = [n = 0](const Pose& p) mutable {
    Pose out = p;
    out.t.x += 0.005 * ((n++ * 7) % 5 - 2);
    return out;
  };
  EXPECT_EQ(ask(jitter).error, "");
}

TEST(GeometrySurvey, PosesThatFitNothingAreWarnedAboutWithTheNumbers) {
  Room room{.poses = walk(24)};
  room.written = [n = 0](const Pose& p) mutable {
    Pose out = p;
    out.t = {std::sin(3.0 * n), 0.7 * std::sin(5.0 * n), std::sin(7.0 * n)};
    ++n;
    return out;
  };
  const Answer a = ask(room);
  EXPECT_EQ(a.error, "");
  EXPECT_EQ(a.warning.find("room: poses and depth do not agree: depth warped between neighbouring frames is off by "),
            0u)
      << a.warning << a.geometry;
}

TEST(GeometrySurvey, DepthOfAnotherUnitIsToldFromPosesOfAnother) {
  Room room{.poses = walk(24)};
  for (const double by : {0.001, 1000.0}) {
    room.spoiled = [by](int, FrameBuffer& f) {
      for (float& d : f.depth_m) d = static_cast<float>(d * by);
    };
    const Answer a = ask(room);
    EXPECT_HAS(a.error, by < 1 ? "depth in metres was read as millimetres" : "depth in millimetres was read as metres")
        << a.error << a.geometry;
    EXPECT_HAS(a.error, by < 1 ? "add --set scene.load.depth_scale=1000 " : "add --set scene.load.depth_scale=0.001 ");
    SceneLoadOptions fixed{.convention = {.depth_scale = 1 / by}};
    expect_quiet(ask(room, fixed), "poses agree with depth");
  }
  room.spoiled = [](int, FrameBuffer&) {};
  room.written = [](const Pose& p) { return times(p, 1000); };
  EXPECT_HAS(ask(room).error, "camera centres are in millimetres where depth is in metres");
}

// Five views from around a room, a fifth of a turn apart.
TEST(GeometrySurvey, DepthOfAnotherUnitIsToldOfFewFrames) {
  Room room{.poses = walk(5, 0.4 * M_PI)};
  expect_quiet(ask(room), "poses agree with depth");
  for (const auto& [scale, named] : {std::pair{6.5535, "6.5535 times"}, {1000.0, "millimetres"}, {4.0, "4 times"}}) {
    room.spoiled = [by = scale](int, FrameBuffer& f) {
      for (float& z : f.depth_m) z *= static_cast<float>(by);
    };
    EXPECT_HAS(ask(room).error, named);
  }
  room.spoiled = [](int, FrameBuffer& f) {
    for (float& z : f.depth_m) z *= 3.3f;
  };
  expect_quiet(ask(room), "could not be checked: few frames, far apart");
}

TEST(GeometrySurvey, DepthInWholeMetresAndInStepsOfOtherSensorsIsTold) {
  Room room{.poses = walk(24)};
  room.spoiled = [](int, FrameBuffer& f) {
    for (float& d : f.depth_m) d = 0.001f * std::round(d);
  };
  const std::string metres = ask(room).error;
  EXPECT_HAS(metres, "depth in metres was read as millimetres", "add --set scene.load.depth_scale=1000 ");
  room.spoiled = [](int, FrameBuffer& f) {
    for (float& d : f.depth_m) d *= 5;
  };
  const std::string fifths = ask(room).error;
  EXPECT_HAS(fifths, "depth is 5 times too large for the camera centres", "add --set scene.load.depth_scale=0.2 ");
}

TEST(GeometrySurvey, AMendThatIsNotNeededIsTakenBack) {
  Room room{.poses = walk(24)};
  SceneLoadOptions options{.convention = {true, true, 1000, 1}};
  const std::string error = ask(room, options).error;
  EXPECT_HAS(error, "poses should not be inverted", "camera axes should not be flipped",
             "camera centres should not be scaled", "--set scene.load.invert_poses=false",
             "--set scene.load.flip_camera_axes=false", "--set scene.load.pose_scale=1 ");
}

TEST(GeometrySurvey, PhotographsWithoutDepthNameAxesAndInverse) {
  Room room{.poses = walk(24)};
  room.depth = false;
  room.width = 320;
  room.height = 240;
  expect_quiet(ask(room), "poses agree with the photographs: ");
  const auto flip = [](const Pose& p) { return opencv_from_opengl(p); };
  struct {
    std::function<Pose(const Pose&)> written;
    std::vector<std::string> said;
    PoseConvention convention;
  } const cases[] = {
      {flip, {"OpenGL axes", "--set scene.load.flip_camera_axes=true"}, {.flip_camera_axes = true}},
      {inverse, {"world-to-camera", "--set scene.load.invert_poses=true"}, {.invert_poses = true}},
      {[&](const Pose& p) { return inverse(flip(p)); },
       {"OpenGL axes", "world-to-camera", "--set scene.load.invert_poses=true --set scene.load.flip_camera_axes=true"},
       {.flip_camera_axes = true, .invert_poses = true}},
  };
  for (const auto& c : cases) {
    room.written = c.written;
    const Answer a = ask(room);
    for (const std::string& part : c.said) EXPECT_HAS(a.error, part) << a.error << a.geometry;
    SceneLoadOptions fixed{.convention = c.convention};
    expect_quiet(ask(room, fixed), "poses agree with the photographs: ");
  }
}

TEST(GeometrySurvey, PhotographsThatTellNothingAreSaidToTellNothing) {
  Room room{.poses = walk(24)};
  room.depth = room.texture = false;
  expect_quiet(ask(room), "could not be checked: no depth, and only ");
  Room still{.poses = std::vector<Pose>(12, walk(5)[4])};
  still.depth = false;
  const Answer one_pose = ask(still);
  EXPECT_HAS(one_pose.geometry, "could not be checked: the camera hardly moves");
  EXPECT_HAS(one_pose.warning, "all 12 frames have one pose");
}

Room photographs(int width = 320) {
  Room room{.poses = walk(24)};
  room.depth = false;
  room.width = width;
  room.height = width * 3 / 4;
  return room;
}

// Every second photograph is darker, at corners that are alike.
TEST(GeometrySurvey, ExposureThatChangesIsMeasuredWhereItIsAskedFor) {
  for (const bool depth : {false, true}) {
    Room room = photographs();
    room.depth = depth;
    const auto exposure_of = [&](bool asked) {
      Diagnostics d;
      return load_scene(room, {.exposure = asked}, d).exposure;
    };
    ASSERT_TRUE(exposure_of(true).has_value());
    EXPECT_NEAR(*exposure_of(true), 1, 0.02) << depth;
    EXPECT_FALSE(exposure_of(false).has_value());
    room.spoiled = [](int i, FrameBuffer& out) {
      for (std::uint8_t& v : out.rgb) v = i % 2 == 0 ? v : static_cast<std::uint8_t>(0.7 * v);
    };
    EXPECT_GT(*exposure_of(true), 1.2) << depth;
  }
}

TEST(GeometrySurvey, PixelsOfAFisheyeAreAngles) {
  Room room = photographs();
  room.fisheye = true;
  expect_quiet(ask(room), "poses agree with the photographs: ");
  EXPECT_GT(std::stod(ask(room).geometry.substr(std::string("poses agree with the photographs: ").size())), 92)
      << ask(room).geometry;
  room.written = inverse;
  EXPECT_HAS(ask(room).error, "world-to-camera");
}

TEST(GeometrySurvey, PosesOfOtherPhotographsAreRefusedAndCanBeForced) {
  Room room = photographs();
  room.written = [n = 0](const Pose&) mutable { return walk(24, 0.2)[n++ * 7 % 24]; };
  const Answer a = ask(room);
  EXPECT_EQ(a.error.find("room: the poses are not those of the photographs: of "), 0u) << a.error << a.geometry;
  EXPECT_HAS(a.error, " lie where any convention puts them; check that the poses are in the order of the images");
  EXPECT_EQ(a.geometry, "poses contradict the photographs");
  SceneLoadOptions forced{.check_geometry = false};
  EXPECT_EQ(ask(room, forced).error, "");
}

TEST(GeometrySurvey, PosesThatFewCornersFitAreWarnedAbout) {
  Room room = photographs();
  room.written = [n = 0](const Pose& p) mutable {  // some frames were tracked, others not
    Pose out = p;
    if (n++ % 5 > 1) out.t = out.t + Vec3d{0.7 * std::sin(3.0 * n), 0.5 * std::sin(5.0 * n), 0.7 * std::sin(7.0 * n)};
    return out;
  };
  const Answer a = ask(room);
  EXPECT_EQ(a.error, "");
  EXPECT_EQ(a.warning.find("room: poses and photographs do not agree: of "), 0u) << a.warning << a.geometry;
}

TEST(GeometrySurvey, IntrinsicsOfAnotherImageSizeAreNamedWithTheFactor) {
  for (const double factor : {2.0, 0.5}) {
    Room room = photographs();
    room.focal = factor;
    const Answer a = ask(room);
    EXPECT_EQ(a.error.find(factor > 1 ? "room: intrinsics are of images 2 times as large: of "
                                      : "room: intrinsics are of images 2 times as small: of "),
              0u)
        << a.error << a.geometry;
    EXPECT_HAS(a.error,
               factor > 1 ? "divide focal lengths and centre by 2," : "multiply focal lengths and centre by 2,");
  }
}

TEST(GeometrySurvey, CornersOfPhotographsLieOnTheWalls) {
  Diagnostics d;
  Room photos = photographs();
  const LoadedScene scene = load_scene(photos, {}, d);
  ASSERT_GT(scene.corners.x.size(), 200u);
  const Box room{{-2, -1.5, -2.5}, {2, 1.5, 2.5}};
  std::size_t inside = 0;
  for (std::size_t i = 0; i < scene.corners.x.size(); ++i) {
    const Vec3d p{scene.corners.x[i], scene.corners.y[i], scene.corners.z[i]};
    bool in = true;
    for (int a = 0; a < 3; ++a) in = in && p[a] > room.lo[a] - 0.3 && p[a] < room.hi[a] + 0.3;
    inside += in ? 1 : 0;
  }
  EXPECT_GT(static_cast<double>(inside), 0.9 * static_cast<double>(scene.corners.x.size()));
  for (int a = 0; a < 3; ++a) {
    EXPECT_LT(scene.bounds.lo[a], room.lo[a] + 0.2) << a;
    EXPECT_GT(scene.bounds.hi[a], room.hi[a] - 0.2) << a;
    EXPECT_GT(scene.bounds.lo[a], room.lo[a] - 1.5) << a;
    EXPECT_LT(scene.bounds.hi[a], room.hi[a] + 1.5) << a;
  }
}

TEST(GeometrySurvey, PhotographsSayTheSameInEveryUnit) {
  Room room = photographs();
  const Answer metres = ask(room);
  for (const double unit : {1e-4, 1e6}) {
    room.written = [unit](const Pose& p) { return times(p, unit); };
    const Answer a = ask(room);
    EXPECT_EQ(a.geometry, metres.geometry) << unit;
    EXPECT_EQ(a.error, "") << unit;
  }
}

TEST(GeometrySurvey, TheVerdictIsTheSameForAnyNumberOfThreads) {
  for (const bool depth : {true, false}) {
    Room room{.poses = walk(24)};
    room.depth = depth;
    room.written = [](const Pose& p) { return inverse(p); };
    set_thread_count(1);
    const Answer one = ask(room);
    set_thread_count(4);
    const Answer four = ask(room);
    set_thread_count(0);
    EXPECT_EQ(one.geometry, four.geometry);
    EXPECT_EQ(one.error, four.error);
    EXPECT_NE(one.error, "");
  }
}

// Corners as sharp as photographs have them, and cameras off by what real captures are off by.
TEST(GeometrySurvey, CamerasThatDoNotFitThePhotographsAreNamedWithWhatFits) {
  for (const bool depth : {false, true}) {
    Room room{.poses = walk(32, 0.08), .depth = depth, .width = 320, .height = 240};
    expect_quiet(ask(room), depth ? "% of " : "poses agree with the photographs");

    Room lens = room;
    lens.focal = 1.12;
    const Answer wrong_lens = ask(lens);
    EXPECT_HAS(wrong_lens.warning, "cameras do not fit the photographs");
    EXPECT_HAS(wrong_lens.warning, "with another lens (focal length ");
    EXPECT_HAS(wrong_lens.warning, "semfield prepare SCENE --out NEW");
    EXPECT_HAS(wrong_lens.geometry, "cameras do not fit the photographs");

    Room shaken = room;
    int frame = 0;
    shaken.written = [&](const Pose& p) {
      const double a = 0.02 * std::sin(2.1 * ++frame), b = 0.02 * std::cos(1.7 * frame);
      return moved(p, {a, b, 0, 0.02 * std::sin(3.3 * frame), 0, 0});
    };
    EXPECT_HAS(ask(shaken).warning, "with corrected poses");
  }
}

TEST(GeometrySurvey, ADelayBetweenPosesAndPhotographsIsNamed) {
  std::vector<Pose> all;
  for (int i = 0; i < 35; ++i) {
    all.push_back(moved({}, {0.1 * std::sin(0.3 * i), -0.03 * i, 0, 0, 0, 0}));
    all.back().t = {0.05 * i - 0.8, 0.1 * std::sin(0.25 * i), 0.3 * std::cos(0.1 * i)};
  }
  Room room{.poses = {all.begin(), all.end() - 1}, .depth = false, .width = 320, .height = 240};
  std::size_t frame = 0;
  room.written = [&](const Pose&) { return all[++frame]; };
  const Answer a = ask(room);
  EXPECT_HAS(a.warning, "with poses of 1 frame earlier") << a.geometry << a.error;
}

TEST(GeometrySurvey, DepthThatLiesBesideThePhotographsIsNamed) {
  Room room{.poses = walk(24, 0.1), .width = 320, .height = 240};
  // Boxes before the walls give depth edges; those of depth are five pixels off.
  const auto boxes = [](int shift) {
    return [shift](int, FrameBuffer& f) {
      for (int y = 20; y < f.height_px; ++y) {
        if (y % 60 > 25) continue;
        for (int x = 40; x < f.width_px; x += 80) {
          for (int i = 0; i < 20; ++i) {
            const auto at = static_cast<std::size_t>(y * f.width_px + x + i);
            std::fill_n(f.rgb.begin() + static_cast<std::ptrdiff_t>(3 * at), 3, std::uint8_t{250});
            if (x + i - shift >= 0) f.depth_m[at - static_cast<std::size_t>(shift)] = 0.4f;
          }
        }
      }
    };
  };
  room.spoiled = boxes(0);
  Diagnostics d;
  EXPECT_FALSE(load_scene(room, {}, d).depth_beside);
  EXPECT_EQ(ask(room).warning, "");
  room.spoiled = boxes(5);
  EXPECT_TRUE(load_scene(room, {}, d).depth_beside);
  EXPECT_HAS(ask(room).warning, "their edges are 5 pixels right of those of depth");
}

}  // namespace
}  // namespace semfield
