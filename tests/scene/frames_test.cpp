// Loading: sizes, bounds, near and far, histograms, every problem in one pass, any number of threads. What is given and
// contradicts the scene: tests/bad_files/scenes.cases.

#include <algorithm>
#include <map>
#include <string>

#include "scene/loading/frame_source.h"
#include "scene/scene.h"
#include "scene/survey/bundle.h"
#include "scene/survey/geometry_survey.h"
#include "tests/scene/tiny_scene.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using namespace testing_room;

// Six frames of the box room; frame 5 is a test frame.
struct RoomDataset {
  bool depth = true, labels = true;
  int broken = -1;
  double offset = 0;
  double stray = 0;      // of the cameras of frame 2 and the next
  int strays = 1;        // so many
  int sparse_depth = 1;  // every n-th pixel has depth
  double far_hint = 0;
  std::vector<std::string> names{"0", "1", "2", "3", "4", "5"};

  SceneInfo open(Diagnostics&) const {
    SceneInfo info;
    info.name = "room";
    info.far_hint_m = far_hint;
    std::vector<ClassEntry> walls;
    for (int i = 0; i < 6; ++i) {
      walls.push_back({i + 1, std::string(1, static_cast<char>('a' + i)), {}, false});
      FrameInfo f{.name = names[i], .camera = room_camera(), .world_from_camera = room_pose(i)};
      f.world_from_camera.t.x += offset + (i >= 2 && i < 2 + strays ? stray : 0);
      f.split = i == 5 ? Split::test : Split::train;
      f.has_depth = depth;
      f.has_labels = labels;
      info.frames.push_back(f);
    }
    info.classes = ClassTable(walls);
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    if (i == broken) throw Error(ErrorKind::data, "test.error.made", "the file is broken", "mend it");
    out = render_room(room_camera(), room_pose(i));
    out.instance.clear();
    if (!depth) out.depth_m.clear();
    if (!labels) out.label.clear();
    for (std::size_t k = 0; k < out.depth_m.size(); ++k) {
      if (k % static_cast<std::size_t>(sparse_depth) != 0) out.depth_m[k] = 0;
    }
  }
};

// A room whose frame 2 has a mask, and whose lens has no ray at the corners of its images.
struct MaskedRoom : RoomDataset {
  Camera camera = room_camera();
  SceneInfo open(Diagnostics& diagnostics) const {
    SceneInfo info = RoomDataset::open(diagnostics);
    for (FrameInfo& frame : info.frames) frame.camera = camera;
    return info;
  }
  void read(int i, FrameBuffer& out) const {
    RoomDataset::read(i, out);
    if (i == 2) out.used.assign(1200, 1);
    for (std::size_t p = 0; p < out.used.size(); ++p) out.used[p] = p / 40 < 10 && p % 40 >= 21 ? 0 : 1;
  }
};

// Without an error.
template <class Source>
LoadedScene loaded(const Source& source, const SceneLoadOptions& options = {}) {
  Diagnostics found;
  LoadedScene scene = load_scene(source, options, found);
  EXPECT_FALSE(found.has_errors()) << all_said(found);
  return scene;
}

TEST(LoadScene, MaskedPixelsHoldNothingAndMaskWhatTheyFallInto) {
  MaskedRoom room;
  for (const double downscale : {1.0, 2.0}) {
    const LoadedScene scene = loaded(room, {.downscale = downscale, .check_geometry = false});
    EXPECT_TRUE(scene.frames[1].mask.empty()) << "it costs nothing where nothing is masked";
    const StoredFrame& frame = scene.frames[2];
    // Column 21 is the second of pixel 10 at half the size.
    EXPECT_EQ(frame.mask.masked_px(), downscale == 1 ? 190 : 50);
    for (std::size_t p = 0; p < frame.label.size(); ++p) {
      const bool masked = downscale == 1 ? p / 40 < 10 && p % 40 >= 21 : p / 20 < 5 && p % 20 >= 10;
      ASSERT_EQ(frame.mask.uses(p), !masked) << p;
      if (!masked) {
        EXPECT_NE(frame.label[p], kVoid);
        EXPECT_GT(frame.depth_m[p], 0);
        continue;
      }
      EXPECT_EQ(frame.label[p], kVoid);
      EXPECT_EQ(frame.depth_m[p], 0);
      EXPECT_EQ(frame.rgb[3 * p] + frame.rgb[3 * p + 1] + frame.rgb[3 * p + 2], 0);
    }
    EXPECT_EQ(scene.class_pixels[2].back(), frame.mask.masked_px());
  }
}

// The room through lenses whose depth is the distance: bounds and the check of poses read it as such.
TEST(LoadScene, DepthOfWideLensesIsTheDistance) {
  struct WideRoom : MaskedRoom {
    void read(int i, FrameBuffer& out) const {
      out = render_room(camera, room_pose(i));
      out.instance.clear();
    }
  } room;
  for (const LensKind lens : {LensKind::fisheye, LensKind::equirectangular}) {
    room.camera = room_camera(64, 48);
    room.camera.lens = lens;
    room.camera.fx = lens == LensKind::fisheye ? 26 : 64 / (2 * M_PI);
    room.camera.fy = lens == LensKind::fisheye ? 26 : 48 / M_PI;
    const LoadedScene scene = loaded(room);
    EXPECT_HAS(scene.geometry, "agree");
    for (int a = 0; a < 3; ++a) {  // walls at 2, 1.5 and 2.5
      const double half = a == 0 ? 2 : a == 1 ? 1.5 : 2.5;
      EXPECT_NEAR(scene.bounds.hi[a], half, 0.3 * half) << a;
      if (lens == LensKind::fisheye && a == 2) continue;  // it does not see what is behind it
      EXPECT_NEAR(scene.bounds.lo[a], -half, 0.3 * half) << a;
    }
    EXPECT_GT(scene.far_m, 2.5);
  }
}

TEST(LoadScene, TrainingFramesCanBeHeldOutInsteadOfTheTestFrames) {
  for (const auto& [every, held_out] : std::map<std::int32_t, std::vector<int>>{{2, {1, 3}}, {3, {1, 4}}, {8, {2}}}) {
    const LoadedScene scene = loaded(RoomDataset(), {.hold_out = every});
    EXPECT_EQ(scene.frames_of(Split::test), held_out) << every;
    EXPECT_EQ(scene.frames_of(Split::train).size(), 5 - held_out.size()) << every;
    EXPECT_EQ(scene.frames_of(Split::unused), std::vector<int>{5}) << "the scene's own test frame";
  }
  Diagnostics d;
  const RoomDataset room;
  (void)load_scene(room, {.hold_out = 1}, d);
  EXPECT_TRUE(d.has_errors());
}

TEST(LoadScene, PixelsWithoutARayAreMasked) {
  MaskedRoom room;
  room.camera.k1 = -0.25;  // r (1 - 0.25 r^2) grows up to r = 1.15, where it is 0.77; the corners are at 1.25
  const LoadedScene scene = loaded(room, {.check_geometry = false});
  const StoredFrame& frame = scene.frames[0];
  ASSERT_FALSE(frame.mask.empty());
  for (std::size_t p = 0; p < 1200; ++p) {
    const Vec3d ray = room.camera.direction(static_cast<double>(p % 40) + 0.5, static_cast<double>(p / 40) + 0.5);
    EXPECT_EQ(frame.mask.uses(p), !(ray == Vec3d{0, 0, 0})) << p;
  }
  EXPECT_GT(scene.frames[2].mask.masked_px(), frame.mask.masked_px()) << "beside its own mask";
}

// What writes files by frames checks nothing: two frames of a scene never share a file.
TEST(LoadScene, FramesThatWouldShareFilesAreRefused) {
  const auto said_of = [](const std::vector<std::string>& names) {
    RoomDataset room{.names = names};
    Diagnostics d;
    (void)load_scene(room, {}, d);
    std::vector<std::string> said;
    for (const Diagnostic& finding : d.all()) {
      EXPECT_EQ(finding.severity, Severity::error);
      EXPECT_EQ(finding.remedy, "give each frame a printable name of its own; '/' becomes '_' in names of files");
      said.push_back(finding.where + ": " + finding.message);
    }
    return said;
  };
  const std::string nul = std::string("c\0d", 3);
  EXPECT_EQ(said_of({"a/b", "a_b", nul, "", "e", "e"}),
            (std::vector<std::string>{"frame 'a_b': its files would be called 'a_b', as those of 'a/b'",
                                      "frame 'c\\x00d': its name has a control character, or is not UTF-8",
                                      "frame '': its name is empty", "frame 'e': another one has its name"}));
  EXPECT_EQ(said_of({"a/b", "a_c", "c", "d", "e", std::string(200, 'f')}), std::vector<std::string>());
  const std::string longer(201, 'f');
  EXPECT_EQ(said_of({"0", "1", "2", "3", "4", longer}),
            std::vector<std::string>{"frame '" + longer + "': its name has 201 bytes; at most 200 are allowed"});
}

TEST(LoadScene, BoundsComeFromDepthOfTrainingFrames) {
  RoomDataset room;
  Diagnostics d;
  const LoadedScene s = load_scene(room, {}, d);
  EXPECT_TRUE(d.all().empty());
  EXPECT_EQ(s.bounds_from, "depth of 5 training frames");
  // Cameras turn from +z to the right: they see the far z wall and the +x wall, floor and ceiling.
  EXPECT_NEAR(s.bounds.hi.x, 2.0, 0.15);
  EXPECT_NEAR(s.bounds.hi.z, 2.5, 0.15);
  EXPECT_NEAR(s.bounds.lo.y, -1.5, 0.15);
  EXPECT_NEAR(s.bounds.hi.y, 1.5, 0.15);
  EXPECT_GT(s.far_m, 2.0);
  EXPECT_LT(s.far_m, 6.5);
  EXPECT_GT(s.near_m, 0.0);
  EXPECT_LT(s.near_m, 1.0);
  EXPECT_NEAR(s.pixel_footprint_m, 2.3 / 20, 0.05);
  EXPECT_EQ(s.frames_of(Split::test), (std::vector<int>{5}));
}

TEST(LoadScene, CameraConesStandInForMissingDepth) {
  RoomDataset room{.depth = false, .far_hint = 3};
  Diagnostics d;
  const LoadedScene s = load_scene(room, {}, d);
  EXPECT_EQ(s.bounds_from, "the view cones of 5 training cameras up to far");
  EXPECT_EQ(s.far_m, 3.0);
  EXPECT_GT(s.bounds.hi.z, 3.0);  // the first camera looks along +z from z = 0.2
  EXPECT_LT(s.bounds.hi.z, 3.7);
  room.far_hint = 0;
  const LoadedScene t = load_scene(room, {}, d);
  EXPECT_EQ(t.near_far_from, "four times the extent of the cameras");
  EXPECT_TRUE(d.all().empty()) << d.all()[0].text();  // a probe will find out
  SceneLoadOptions unprobed{.probe_steps = 0};
  EXPECT_TRUE(load_scene(room, unprobed, d).extent_is_guessed);
  ASSERT_EQ(d.all().size(), 1u);
  EXPECT_HAS(d.all()[0].text(), "are a guess");
  EXPECT_HAS(d.all()[0].remedy, "scene.load.probe_steps: 128");
}

TEST(LoadScene, ThinDepthIsJoinedByTheCones) {
  RoomDataset room{.sparse_depth = 3};
  EXPECT_HAS(loaded(room).bounds_from, "and the view cones");
}

TEST(LoadScene, ResizesColourByAreaAndTheRestByNearest) {
  const RoomDataset room;
  const LoadedScene s = loaded(room, {.width_px = 20});
  ASSERT_EQ(s.frames[0].width_px, 20);
  ASSERT_EQ(s.frames[0].height_px, 15);
  EXPECT_EQ(s.info.frames[0].camera.fx, 10.0);
  FrameBuffer whole;
  room.read(0, whole);
  for (int y = 0; y < 15; ++y) {
    for (int x = 0; x < 20; ++x) {
      const auto to = static_cast<std::size_t>(y * 20 + x),
                 from = static_cast<std::size_t>((2 * y + 1) * 40 + 2 * x + 1);
      EXPECT_EQ(s.frames[0].label[to], whole.label[from]);
      EXPECT_EQ(s.frames[0].depth_m[to], whole.depth_m[from]);
      const int sum =
          whole.rgb[from * 3] + whole.rgb[(from - 1) * 3] + whole.rgb[(from - 40) * 3] + whole.rgb[(from - 41) * 3];
      EXPECT_EQ(s.frames[0].rgb[to * 3], (sum + 2) / 4);
    }
  }
}

TEST(LoadScene, HistogramCountsEveryPixel) {
  RoomDataset room;
  const LoadedScene s = loaded(room);
  FrameBuffer f;
  room.read(2, f);
  std::vector<std::int64_t> want(7);
  for (const std::int16_t c : f.label) ++want[c];
  EXPECT_EQ(s.class_pixels[2], want);
  room.labels = false;
  EXPECT_TRUE(loaded(room).class_pixels[2].empty());
}

TEST(LoadScene, BrokenFramesAreListedAndTheRestIsRead) {
  RoomDataset room{.broken = 3};
  Diagnostics d;
  const LoadedScene s = load_scene(room, {}, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].text(), "frame '3': the file is broken; mend it");
  EXPECT_TRUE(s.frames[3].rgb.empty());
  EXPECT_FALSE(s.frames[4].rgb.empty());
}

TEST(LoadScene, AStrayCameraIsNamedWhateverTheUnit) {
  for (const double scale : {1e-4, 1.0, 1e6}) {
    SceneLoadOptions options{.check_geometry = false};
    options.convention.pose_scale = options.convention.depth_scale = scale;
    RoomDataset room;
    Diagnostics none;
    const LoadedScene scene = load_scene(room, options, none);
    EXPECT_TRUE(none.all().empty()) << none.all()[0].text();
    EXPECT_NEAR(scene.bounds.size().x, 4 * scale, 0.4 * scale);
    room.stray = 1e7;
    Diagnostics d;
    (void)load_scene(room, options, d);
    ASSERT_EQ(d.error_count(), 1) << scale;
    EXPECT_FINDING(d, "scene.pose.far", "frame '2'", "times as far as they are");
    room.strays = 3;  // half of all: which of the two groups is astray, nobody knows
    Diagnostics groups;
    (void)load_scene(room, options, groups);
    ASSERT_EQ(groups.error_count(), 1) << scale;
    EXPECT_FINDING(groups, "scene.pose.far", "times as far as what cameras see");
  }
}

TEST(LoadScene, SameForAnyNumberOfThreads) {
  const auto made = [] { return loaded(RoomDataset()); };
  const LoadedScene a = on_threads(1, made), b = on_threads(3, made);
  EXPECT_EQ(a.bounds.lo, b.bounds.lo);
  EXPECT_EQ(a.bounds.hi, b.bounds.hi);
  EXPECT_EQ(a.far_m, b.far_m);
  EXPECT_EQ(a.pixel_footprint_m, b.pixel_footprint_m);
  for (std::size_t i = 0; i < 6; ++i) EXPECT_EQ(a.frames[i].rgb, b.frames[i].rgb);
}

TEST(LoadScene, TellsHowFarItIsAndThatItEnded) {
  RoomDataset room;
  std::vector<std::size_t> told;
  bool ended = false;
  const LoadProgress progress = [&](std::string_view doing, std::size_t done, std::size_t total) {
    EXPECT_FALSE(ended);
    ended = doing == "read";
    if (ended) return;
    EXPECT_EQ(doing, "reading");
    EXPECT_EQ(total, 6u);
    told.push_back(done);
  };
  WorkSettings work{.load_progress = &progress};
  const WorkScope scope(work);
  Diagnostics d;
  (void)load_scene(room, {}, d);
  EXPECT_TRUE(ended);
  std::sort(told.begin(), told.end());  // threads may pass each other
  EXPECT_EQ(told, (std::vector<std::size_t>{1, 2, 3, 4, 5, 6}));

  ended = false;
  struct Broken : RoomDataset {
    SceneInfo open(Diagnostics&) const { throw Error(ErrorKind::no_input, "test.error.made", "gone"); }
  } gone;
  EXPECT_THROW((void)load_scene(gone, {}, d), Error);
  EXPECT_TRUE(ended);
}

// Poses before they are believed, and the bounds that a scene gets. Cameras: tests/bad_files/scenes.cases.

TEST(SceneChecks, GoodPosePassesUnchanged) {
  Diagnostics d;
  Pose p = testing_room::room_pose(3);
  const Pose before = p;
  EXPECT_EQ(check_pose(p, "here", d), PoseState::good);
  EXPECT_EQ(p.r, before.r);
  EXPECT_TRUE(d.all().empty());
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

TEST(SceneChecks, OpenGlAxesTurn) {
  const Pose p =
      opencv_from_opengl(pose_from_rows(std::vector<double>{1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1}));
  EXPECT_EQ(p.axis(0), (Vec3d{1, 0, 0}));
  EXPECT_EQ(p.axis(1), (Vec3d{0, -1, 0}));
  EXPECT_EQ(p.axis(2), (Vec3d{0, 0, -1}));
  EXPECT_EQ(p.t, (Vec3d{5, 6, 7}));
}

// Bounds of scenes without depth: around an object before one colour, inside the file's own limit, and the cameras'
// rig.

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
  bool noisy_background = false;

  SceneInfo open(Diagnostics&) const {
    SceneInfo info{.name = "object"};
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

// That `found` holds `box` and reaches at most `most` beyond it.
void expect_around(const Box& found, const Box& box, double most) {
  for (int a = 0; a < 3; ++a) {
    EXPECT_LE(found.lo[a], box.lo[a]) << a;
    EXPECT_GE(found.hi[a], box.hi[a]) << a;
    EXPECT_GT(found.lo[a], box.lo[a] - most) << a;
    EXPECT_LT(found.hi[a], box.hi[a] + most) << a;
  }
}

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
  expect_around(s.bounds, {object.center - object.half, object.center + object.half}, 0.4);
  EXPECT_GT(s.near_m, 1.5);
  EXPECT_LT(s.near_m, 4 - 1.3);
  EXPECT_GT(s.far_m, 4 + 1.3);
  EXPECT_LT(s.far_m, 8);
}

TEST(SceneBounds, OtherBackgroundsLeaveTheViewCones) {
  ObjectDataset object{.noisy_background = true};
  const LoadedScene s = loaded(object);
  EXPECT_FALSE(s.plain_background.has_value());
  EXPECT_TRUE(s.rig.inward);
  EXPECT_TRUE(s.extent_is_guessed);
  EXPECT_EQ(s.bounds_from, "the view cones of 35 training cameras up to far");
}

// Far is as good as infinity there: a pixel is measured where the bounds are, also where cameras look outward.
TEST(SceneBounds, APixelOfContractedSpaceIsThatOfTheBounds) {
  struct Outward : ObjectDataset {
    SceneInfo open(Diagnostics& d) const {
      SceneInfo info = ObjectDataset::open(d);
      for (FrameInfo& frame : info.frames)
        frame.world_from_camera = look_at(frame.world_from_camera.t, frame.world_from_camera.t * 2 - center);
      return info;
    }
  } outward;
  const LoadedScene s = loaded(outward, {.check_geometry = false, .contracted = true});
  const Vec3d size = s.bounds.size();
  const double longest = std::max({size.x, size.y, size.z});
  EXPECT_GT(s.far_m, 20 * longest);
  EXPECT_NEAR(s.pixel_footprint_m, 0.5 * longest / s.info.frames[0].camera.fx, 1e-7);  // a median in float
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
  // The ball in all cones has the radius 4 sin(20 degrees).
  expect_around(rig.seen, {center - Vec3d{1.2, 1.2, 1.2}, center + Vec3d{1.2, 1.2, 1.2}}, 1.8);
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
  EXPECT_TRUE(rig_of(one_side).forward);
  EXPECT_TRUE(rig_of(parallel).forward);
  std::vector<FrameInfo> ahead;
  for (int i = 0; i < 24; ++i) ahead.push_back(frame_at({0.02 * (i % 3), 0, 0.1 * i}, {0, 0, 99}));
  for (const auto* frames : {&panorama, &walk, &outward, &ahead}) EXPECT_FALSE(rig_of(*frames).forward);
  EXPECT_FALSE(rig_of({}).forward);
  for (FrameInfo& frame : parallel) frame.camera.lens = LensKind::equirectangular;
  EXPECT_FALSE(rig_of(parallel).forward);
}

// Poses against pixels: every convention is named from depth and from photographs, and right scenes are left in peace.

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
  expect_quiet(ask({.poses = walk(8, 0.6)}), "poses agree with depth");
  expect_quiet(ask({.poses = walk(200, 0.01), .width = 40, .height = 30}), "poses agree with depth");
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

TEST(GeometrySurvey, DepthOfAnotherUnitIsTold) {
  const Room room{.poses = walk(24)}, few{.poses = walk(5, 0.4 * M_PI)};  // few: from around a room, far apart
  expect_quiet(ask(few), "poses agree with depth");
  const auto scaled = [](double by) { return [by](float z) { return static_cast<float>(z * by); }; };
  const std::string millimetres = "depth in metres was read as millimetres", metres = "millimetres was read as metres";
  const auto add = [](const std::string& by) { return "add --set scene.load.depth_scale=" + by + " "; };
  struct Row {
    const Room& room;
    std::function<float(float)> depth;
    std::vector<std::string> said;
    double depth_scale = 0;  // that corrects it; 0: of which that is not asked
  };
  const std::vector<Row> rows{{room, scaled(0.001), {millimetres, add("1000")}, 1000},
                              {room, scaled(1000), {"depth in " + metres, add("0.001")}, 0.001},
                              {room, [](float z) { return 0.001f * std::round(z); }, {millimetres, add("1000")}},
                              {room, scaled(5), {"depth is 5 times too large for the camera centres", add("0.2")}},
                              {few, scaled(6.5535), {"6.5535 times"}},
                              {few, scaled(1000), {"millimetres"}},
                              {few, scaled(4), {"4 times"}},
                              {few, scaled(3.3), {}}};
  for (const auto& row : rows) {
    Room written = row.room;
    written.spoiled = [&](int, FrameBuffer& f) {
      std::transform(f.depth_m.begin(), f.depth_m.end(), f.depth_m.begin(), row.depth);
    };
    const Answer a = ask(written);
    for (const std::string& part : row.said) EXPECT_HAS(a.error, part) << a.error << a.geometry;
    if (row.said.empty()) expect_quiet(a, "could not be checked: few frames, far apart");
    if (row.depth_scale > 0)
      expect_quiet(ask(written, {.convention = {.depth_scale = row.depth_scale}}), "poses agree with depth");
  }
  Room far = room;
  far.written = [](const Pose& p) { return times(p, 1000); };
  EXPECT_HAS(ask(far).error, "camera centres are in millimetres where depth is in metres");
}

TEST(GeometrySurvey, AMendThatIsNotNeededIsTakenBack) {
  Room room{.poses = walk(24)};
  SceneLoadOptions options{.convention = {true, true, 1000, 1}};
  const std::string error = ask(room, options).error;
  EXPECT_HAS(error, "poses should not be inverted", "camera axes should not be flipped",
             "camera centres should not be scaled", "--set scene.load.invert_poses=false",
             "--set scene.load.flip_camera_axes=false", "--set scene.load.pose_scale=1 ");
}

Room photographs() { return {.poses = walk(24), .depth = false, .width = 320, .height = 240}; }

TEST(GeometrySurvey, PhotographsWithoutDepthNameAxesAndInverse) {
  Room room = photographs();
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
    expect_quiet(ask(room, {.convention = c.convention}), "poses agree with the photographs: ");
  }
}

TEST(GeometrySurvey, PhotographsThatTellNothingAreSaidToTellNothing) {
  expect_quiet(ask({.poses = walk(24), .depth = false, .texture = false}), "could not be checked: no depth, and only ");
  const Answer one_pose = ask({.poses = std::vector<Pose>(12, walk(5)[4]), .depth = false});
  EXPECT_HAS(one_pose.geometry, "could not be checked: the camera hardly moves");
  EXPECT_HAS(one_pose.warning, "all 12 frames have one pose");
}

// Every second photograph is darker, at corners that are alike.
TEST(GeometrySurvey, ExposureThatChangesIsMeasuredWhereItIsAskedFor) {
  for (const bool depth : {false, true}) {
    Room room = photographs();
    room.depth = depth;
    const auto exposure_of = [&](bool asked) { return loaded(room, {.exposure = asked}).exposure; };
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
  for (const auto& [factor, size, mend] : {std::tuple{2.0, "large", "divide"}, std::tuple{0.5, "small", "multiply"}}) {
    Room room = photographs();
    room.focal = factor;
    const Answer a = ask(room);
    EXPECT_TRUE(a.error.starts_with("room: intrinsics are of images 2 times as " + std::string(size) + ": of "));
    EXPECT_HAS(a.error, mend + std::string(" focal lengths and centre by 2,")) << a.geometry;
  }
}

TEST(GeometrySurvey, CornersOfPhotographsLieOnTheWalls) {
  const LoadedScene scene = loaded(photographs());
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
  const Vec3d off{0.2, 0.2, 0.2};
  expect_around(scene.bounds, {room.lo + off, room.hi - off}, 1.7);
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
    const auto made = [&] { return ask({.poses = walk(24), .written = inverse, .depth = depth}); };
    const Answer one = on_threads(1, made), four = on_threads(4, made);
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
    EXPECT_HAS(wrong_lens.warning, "cameras do not fit the photographs", "with another lens (focal length ",
               "semfield prepare SCENE --out NEW");
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
  EXPECT_FALSE(loaded(room).depth_beside);
  EXPECT_EQ(ask(room).warning, "");
  room.spoiled = boxes(5);
  EXPECT_TRUE(loaded(room).depth_beside);
  EXPECT_HAS(ask(room).warning, "whose edges are 5 pixels right of those of depth");
}

}  // namespace
}  // namespace semfield
