// Loading: sizes, bounds, near and far, histograms, every problem in one pass, any number of threads.
#include "loading/frame_source.h"

#include <algorithm>
#include <sstream>

#include "compute/parallel.h"
#include "tests/scene/tiny_scene.h"

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
    info.classes = ClassTable({{1, "a", {}, false},
                               {2, "b", {}, false},
                               {3, "c", {}, false},
                               {4, "d", {}, false},
                               {5, "e", {}, false},
                               {6, "f", {}, false}});
    for (int i = 0; i < 6; ++i) {
      FrameInfo f{.name = names[i], .camera = room_camera(), .world_from_camera = room_pose(i)};
      f.world_from_camera.t.x += offset + (i >= 2 && i < 2 + strays ? stray : 0);
      f.split = i == 5 ? Split::test : Split::train;
      f.has_depth = depth;
      f.has_labels = labels;
      info.frames.push_back(f);
    }
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

TEST(LoadScene, MaskedPixelsHoldNothingAndMaskWhatTheyFallInto) {
  MaskedRoom room;
  for (const double downscale : {1.0, 2.0}) {
    Diagnostics d;
    SceneLoadOptions options;
    options.downscale = downscale;
    options.check_geometry = false;
    const LoadedScene scene = load_scene(room, options, d);
    ASSERT_FALSE(d.has_errors()) << d.all()[0].text();
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
    Diagnostics d;
    const LoadedScene scene = load_scene(room, {}, d);
    EXPECT_FALSE(d.has_errors());
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

TEST(LoadScene, PixelsWithoutARayAreMasked) {
  MaskedRoom room;
  room.camera.k1 = -0.25;  // r (1 - 0.25 r^2) grows up to r = 1.15, where it is 0.77; the corners are at 1.25
  Diagnostics d;
  SceneLoadOptions options;
  options.check_geometry = false;
  const LoadedScene scene = load_scene(room, options, d);
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
  Diagnostics d;
  EXPECT_HAS(load_scene(room, {}, d).bounds_from, "and the view cones");
}

TEST(LoadScene, OptionsWin) {
  RoomDataset room;
  SceneLoadOptions o{.near_m = 0.25, .far_m = 4, .bounds = {-1, -2, -3, 1, 2, 3}};
  Diagnostics d;
  const LoadedScene s = load_scene(room, o, d);
  EXPECT_EQ(s.near_m, 0.25);
  EXPECT_EQ(s.far_m, 4.0);
  EXPECT_EQ(s.bounds.hi, (Vec3d{1, 2, 3}));
  EXPECT_EQ(s.bounds_from, "the configuration");
}

TEST(LoadScene, ResizesColourByAreaAndTheRestByNearest) {
  RoomDataset room;
  SceneLoadOptions o{.width_px = 20};
  Diagnostics d;
  const LoadedScene s = load_scene(room, o, d);
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
  o.width_px = 80;
  Diagnostics grow;
  (void)load_scene(room, o, grow);
  EXPECT_EQ(grow.error_count(), 6);
  EXPECT_EQ(grow.all()[0].text(),
            "frame '0': frame is 40 x 30 pixels, smaller than the size asked for; ask for at most the stored size");
}

TEST(LoadScene, HistogramCountsEveryPixel) {
  RoomDataset room;
  Diagnostics d;
  const LoadedScene s = load_scene(room, {}, d);
  FrameBuffer f;
  room.read(2, f);
  std::vector<std::int64_t> want(7);
  for (const std::int16_t c : f.label) ++want[c];
  EXPECT_EQ(s.class_pixels[2], want);
  room.labels = false;
  EXPECT_TRUE(load_scene(room, {}, d).class_pixels[2].empty());
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

TEST(LoadScene, FarOriginIsWarnedAbout) {
  RoomDataset room{.offset = 1e6};
  Diagnostics d;
  (void)load_scene(room, {}, d);
  ASSERT_EQ(d.all().size(), 1u);
  EXPECT_EQ(d.all()[0].remedy, "move the origin of the poses near the scene");
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
  RoomDataset room;
  Diagnostics d;
  set_thread_count(1);
  const LoadedScene a = load_scene(room, {}, d);
  set_thread_count(3);
  const LoadedScene b = load_scene(room, {}, d);
  set_thread_count(0);
  EXPECT_EQ(a.bounds.lo, b.bounds.lo);
  EXPECT_EQ(a.bounds.hi, b.bounds.hi);
  EXPECT_EQ(a.far_m, b.far_m);
  EXPECT_EQ(a.pixel_footprint_m, b.pixel_footprint_m);
  for (std::size_t i = 0; i < 6; ++i) EXPECT_EQ(a.frames[i].rgb, b.frames[i].rgb);
}

TEST(LoadScene, ContradictingOptionsAreRefused) {
  Diagnostics d;
  SceneLoadOptions o{.width_px = 10, .downscale = 2, .near_m = 3, .far_m = 2, .bounds = {0, 0, 0, 1, 0, 1}};
  validate(o, d);
  ASSERT_EQ(d.error_count(), 3);
  EXPECT_EQ(d.all()[0].text(),
            "scene.load.downscale: downscale and width_px or height_px exclude each other; keep one of them");
}

// The text of `severity` about `key`, "" when there is none.
std::string said(const Diagnostics& d, Severity severity, const std::string& key) {
  for (const Diagnostic& x : d.all()) {
    if (x.severity == severity && x.where == key) return x.text();
  }
  return {};
}

TEST(LoadScene, BoundsBesideTheViewAreRefusedWithTheBoxThatTheDataSuggest) {
  RoomDataset room;
  SceneLoadOptions o{.bounds = {20, 20, 20, 21, 21, 21}};
  Diagnostics d;
  (void)load_scene(room, o, d);
  const std::string text = said(d, Severity::error, "scene.load.bounds");
  EXPECT_EQ(text.find("scene.load.bounds: none of the rays of the training cameras can meet the bounds "
                      "[20,20,20,21,21,21] (from the configuration); the data suggest --set 'scene.load.bounds=["),
            0u)
      << text;
  // The box that is named works.
  const std::size_t at = text.find("bounds=[") + 8;
  o.bounds.clear();
  std::stringstream numbers(text.substr(at, text.find(']', at) - at));
  for (std::string value; std::getline(numbers, value, ',');) o.bounds.push_back(std::stod(value));
  ASSERT_EQ(o.bounds.size(), 6u);
  Diagnostics again;
  const LoadedScene s = load_scene(room, o, again);
  EXPECT_FALSE(again.has_errors());
  EXPECT_NEAR(s.bounds.hi.x, 2, 0.2);
  o.bounds = {20, 20, 20, 21, 21, 21};
  o.check_geometry = false;
  Diagnostics unchecked;
  (void)load_scene(room, o, unchecked);
  EXPECT_FALSE(unchecked.has_errors());
}

TEST(LoadScene, BoundsThatFewRaysMeetAreWarnedAbout) {
  RoomDataset room;
  SceneLoadOptions o{.bounds = {-0.2, -0.2, 2.3, 0.2, 0.2, 2.5}};
  Diagnostics d;
  (void)load_scene(room, o, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(said(d, Severity::warning, "scene.load.bounds").find("scene.load.bounds: only "), 0u);
}

TEST(LoadScene, NearAndFarBesideDepthOrBoundsAreRefusedWithOnesThatWork) {
  for (const bool depth : {true, false}) {
    RoomDataset room{.depth = depth};
    SceneLoadOptions o{.near_m = 200, .far_m = 300, .bounds = {-2, -1.5, -2.5, 2, 1.5, 2.5}};
    Diagnostics d;
    (void)load_scene(room, o, d);
    const std::string text = said(d, Severity::error, "scene.load.near_m");
    EXPECT_HAS(text, depth ? "none of the depth of the training frames is between near 200 and far 300"
                           : "can be inside the bounds between near 200 and far 300");
    o.near_m = std::stod(text.substr(text.find("near_m=") + 7));
    o.far_m = std::stod(text.substr(text.find("far_m=") + 6));
    Diagnostics again;
    (void)load_scene(room, o, again);
    EXPECT_FALSE(again.has_errors());
  }
}

// A dataset that could not read its classes has said so; its labels say nothing more.
TEST(LoadScene, WithoutClassesOnlyTheirCauseIsTold) {
  struct NoClasses : RoomDataset {
    SceneInfo open(Diagnostics& d) const {
      SceneInfo info = RoomDataset::open(d);
      info.classes = {};
      d.error("test.finding.made", "classes.yaml", "no classes in it", "write one");
      return info;
    }
  } room;
  Diagnostics d;
  const LoadedScene s = load_scene(room, {}, d);
  ASSERT_EQ(d.all().size(), 1u) << d.all()[1].text();
  EXPECT_EQ(d.all()[0].text(), "classes.yaml: no classes in it; write one");
  EXPECT_FALSE(s.info.frames[0].has_labels);
}

TEST(LoadScene, OneFrameIsNoScene) {
  struct One : RoomDataset {
    SceneInfo open(Diagnostics& d) const {
      SceneInfo info = RoomDataset::open(d);
      info.frames.resize(1);
      info.frames[0].split = Split::test;
      return info;
    }
  } room;
  Diagnostics d;
  (void)load_scene(room, {}, d);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_HAS(d.all()[0].text(), "frame '0'", "only frame", "give two frames");
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

}  // namespace
}  // namespace semfield
