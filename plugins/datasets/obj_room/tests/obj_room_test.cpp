// The dataset on the shipped room, on rooms with faults, and on other people's rooms where they are at hand.

#include "datasets/obj_room/obj_room.h"

#include <algorithm>
#include <cstdlib>
#include <map>
#include <set>

#include "app/scene/folder_scene.h"
#include "core/error.h"
#include "core/files.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "tests/datasets/named_dataset.h"
#include "tests/datasets/rewritten_poses.h"

namespace semfield {
namespace {

using namespace testing_obj;

/// A quick room, with further or other settings.
NamedDataset small(const std::string& root, testkit::Settings settings = {}) {
  settings.insert({{"root", root},
                   {"width_px", "40"},
                   {"height_px", "30"},
                   {"frames", "4"},
                   {"test_frames", "2"},
                   {"supersample", "1"},
                   {"occlusion_rays", "2"},
                   {"shadow_rays", "1"}});
  return NamedDataset("obj_room", settings);
}

const std::string kShipped = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room";

/// Problems of a scene just opened, and its frames against what any scene promises.
void check_frames(const NamedDataset& room, const SceneInfo& info, int total) {
  ASSERT_EQ(static_cast<int>(info.frames.size()), total);
  std::set<std::int16_t> seen;
  std::int64_t hit = 0, pixels = 0;
  for (int i = 0; i < total; ++i) {
    const FrameBuffer f = room.read(i);
    for (std::size_t k = 0; k < f.label.size(); ++k) {
      ASSERT_GE(f.label[k], kVoid);
      ASSERT_LT(f.label[k], info.classes.valid_count());
      ASSERT_TRUE(std::isfinite(f.depth_m[k]));
      ASSERT_EQ(f.depth_m[k] > 0, f.instance[k] > 0);
      if (f.label[k] >= 0) seen.insert(f.label[k]);
      hit += f.depth_m[k] > 0 ? 1 : 0;
      ++pixels;
    }
  }
  EXPECT_GE(seen.size(), 4u);
  EXPECT_GT(hit, pixels * 8 / 10);
}

TEST(ObjRoomShipped, IsRichSmallAndWithoutFault) {
  NamedDataset room = small(kShipped, {{"frames", "12"}, {"test_frames", "4"}});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  EXPECT_EQ(all_said(d), "");
  EXPECT_GE(info.classes.valid_count(), 12);
  check_frames(room, info, 16);
  EXPECT_GT(info.near_hint_m, 0);
  EXPECT_GT(info.far_hint_m, info.near_hint_m);
}

TEST(ObjRoomShipped, TrainAndTestFramesAreDistinctAndSpread) {
  NamedDataset room = small(kShipped, {{"width_px", "8"}, {"height_px", "6"}, {"frames", "30"}, {"test_frames", "10"}});
  const SceneInfo info = room.open();
  std::set<std::string> names;
  std::set<std::array<double, 6>> poses;
  int train = 0, test = 0;
  for (const FrameInfo& f : info.frames) {
    const Pose& w = f.world_from_camera;
    names.insert(f.name);
    poses.insert({w.t.x, w.t.y, w.t.z, w.r[0][2], w.r[1][2], w.r[2][2]});
    train += f.split == Split::train ? 1 : 0;
    test += f.split == Split::test ? 1 : 0;
    EXPECT_TRUE(f.has_depth && f.has_labels && f.has_instances);
  }
  EXPECT_EQ(train, 30);
  EXPECT_EQ(test, 10);
  EXPECT_EQ(names.size(), 40u);
  EXPECT_EQ(poses.size(), 40u);
  // One test frame in every four.
  for (std::size_t i = 0; i < 40; i += 4) {
    int here = 0;
    for (std::size_t k = i; k < i + 4; ++k) here += info.frames[k].split == Split::test ? 1 : 0;
    EXPECT_EQ(here, 1) << "frames from " << i;
  }
}

std::string room_folder() {
  const std::string folder = fresh_folder("room");
  write_room(folder);
  return folder;
}

TEST(ObjRoom, CamerasOfAFileAndBoundsFromWhatTheyMeet) {
  NamedDataset room = small(room_folder(), {{"cameras", "cameras.txt"}});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  EXPECT_EQ(all_said(d), "");
  ASSERT_EQ(info.frames.size(), 6u);
  EXPECT_NEAR(info.frames[3].world_from_camera.t.x, 0.1, 1e-9);
  EXPECT_EQ(info.frames[3].world_from_camera.axis(2), (Vec3d{0, 1, 0}));
  EXPECT_NEAR(info.frames[0].camera.fx, 20, 1e-9);  // 90 degrees over 40 pixels
  for (int a = 0; a < 3; ++a) {
    EXPECT_GE(info.bounds.lo[a], kRoom.lo[a] - 0.051);
    EXPECT_LE(info.bounds.hi[a], kRoom.hi[a] + 0.051);
  }
  EXPECT_NEAR(info.bounds.hi.y, 1.55, 1e-6);
  const FrameBuffer f = room.read(2);
  const Vec3d c = info.frames[2].world_from_camera.t, axis = info.frames[2].camera.direction(20.5, 20.5);
  EXPECT_NEAR(f.depth_m[20 * 40 + 20], room_truth(c, info.frames[2].world_from_camera.rotate(axis)).distance * axis.z,
              1e-5);
  EXPECT_EQ(error_of([&] { room.read(6); }), "frame 6 of 6 was asked for");
}

// Every side of the crate, and every wall, is an object of its own in the file.
TEST(ObjRoom, InstancesAreObjectsOfTheFileOrPieces) {
  const std::string folder = room_folder();
  const auto instances = [&](const std::string& are) {  // of each class
    NamedDataset room = small(folder, {{"cameras", "cameras.txt"}, {"instances", are}});
    const SceneInfo info = room.open();
    std::map<std::string, std::set<std::int32_t>> out;
    for (int i = 0; i < static_cast<int>(info.frames.size()); ++i) {
      const FrameBuffer f = room.read(i);
      for (std::size_t k = 0; k < f.label.size(); ++k)
        if (f.label[k] >= 0) out[info.classes.valid(f.label[k]).name].insert(f.instance[k]);
    }
    return out;
  };
  EXPECT_GE(instances("objects").at("crate").size(), 2u);
  EXPECT_GE(instances("objects").at("wall").size(), 3u);
  const auto pieces = instances("pieces");
  std::set<std::int32_t> all;
  for (const auto& [name, ids] : pieces) {
    EXPECT_EQ(ids.size(), 1u) << name;
    all.insert(ids.begin(), ids.end());
  }
  EXPECT_EQ(all.size(), pieces.size()) << "pieces of two classes have two numbers";
}

TEST(ObjRoom, GivenNearFarAndBoundsHold) {
  NamedDataset room = small(room_folder(), {{"bounds", "-2,-1.5,0,0,1.5,2.5"}, {"near_m", "0.2"}, {"far_m", "7"}});
  const SceneInfo info = room.open();
  EXPECT_EQ(info.near_hint_m, 0.2);
  EXPECT_EQ(info.far_hint_m, 7);
  for (const FrameInfo& f : info.frames) EXPECT_LE(f.world_from_camera.t.x, 0.35);
}

TEST(ObjRoom, SettingsThatContradictAreNamed) {
  const std::string said = error_of([] {
    small("room", {{"lowest_m", "2"}, {"bounds", "0,0,0,1,-1,1"}, {"near_m", "3"}, {"far_m", "2"}});
  });
  EXPECT_HAS(said, "highest_m", "far_m", "bounds");
}

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

class ObjRoomOthers : public testing::TestWithParam<std::pair<const char*, int>> {};

TEST_P(ObjRoomOthers, OpensWithItsClassesAndPoses) {
  const auto& [name, classes] = GetParam();
  if (!fs::exists(data(name))) GTEST_SKIP() << "the optional OBJ rooms are not at hand";
  NamedDataset room = small(data(name), {{"width_px", "64"}, {"height_px", "48"}, {"up", "y"}, {"frames", "16"}});
  const SceneInfo info = room.open();
  EXPECT_EQ(info.classes.valid_count(), classes);
  check_frames(room, info, 18);
  expect_conventions_told(room, "poses agree with depth");
}
INSTANTIATE_TEST_SUITE_P(Rooms, ObjRoomOthers,
                         testing::Values(std::pair("obj_living_room", 16), std::pair("obj_classroom", 19)),
                         [](const auto& room) { return std::string(room.param.first); });

TEST(ObjRoomShipped, PoseConventionsAreTold) {
  NamedDataset room = small(kShipped, {{"width_px", "64"}, {"height_px", "48"}, {"frames", "16"}});
  expect_conventions_told(room, "poses agree with depth");
}

// A captured room is the room, every channel through the Replica layout and back; cast frames are kept and found again.

NamedDataset captured(const std::string& root) {
  return NamedDataset("replica", {{"root", root}, {"train_step", "1"}, {"test_step", "0"}});
}

/// Captures what `source` gives, opens it as Replica frames and compares.
void round_trip(Dataset& source, int frames, const std::string& folder) {
  Diagnostics d;
  const SceneInfo info = source.open(d);
  std::vector<int> progress;
  const app::PackSummary report = app::capture_replica(source, info, folder, [&](int done, int total) {
    EXPECT_EQ(total, frames);
    progress.push_back(done);
  });
  EXPECT_EQ(report.frames, frames);
  EXPECT_EQ(static_cast<int>(progress.size()), frames);
  EXPECT_GT(report.bytes, 500u);

  NamedDataset replica = captured(folder);
  const SceneInfo back = replica.open(d);
  EXPECT_EQ(all_said(d), "");
  ASSERT_EQ(back.frames.size(), static_cast<std::size_t>(frames));
  ASSERT_EQ(back.classes.valid_count(), info.classes.valid_count());
  for (int c = 0; c < info.classes.valid_count(); ++c) {
    EXPECT_EQ(back.classes.valid(c).id, info.classes.valid(c).id);
    EXPECT_EQ(back.classes.valid(c).name, info.classes.valid(c).name);
    EXPECT_EQ(back.classes.valid(c).color, info.classes.valid(c).color);
  }
  for (int i = 0; i < frames; ++i) {
    const FrameInfo &a = info.frames[i], &b = back.frames[i];
    EXPECT_NEAR(length(a.world_from_camera.t - b.world_from_camera.t), 0, 1e-12);
    for (int k = 0; k < 3; ++k)
      EXPECT_NEAR(length(a.world_from_camera.axis(k) - b.world_from_camera.axis(k)), 0, 1e-12);
    EXPECT_NEAR(a.camera.fx, b.camera.fx, 1e-9);
    EXPECT_EQ(a.camera.cx, b.camera.cx);
    EXPECT_EQ(a.camera.cy, b.camera.cy);
    EXPECT_TRUE(b.has_depth && b.has_labels && b.has_instances);
    FrameBuffer fa;
    source.read(i, fa);
    const FrameBuffer fb = replica.read(i);
    EXPECT_EQ(fa.rgb, fb.rgb);
    EXPECT_EQ(fa.label, fb.label);
    EXPECT_EQ(fa.instance, fb.instance);
    ASSERT_EQ(fa.depth_m.size(), fb.depth_m.size());
    for (std::size_t k = 0; k < fa.depth_m.size(); ++k) ASSERT_NEAR(fa.depth_m[k], fb.depth_m[k], 0.000501);
  }
}

TEST(Capture, ShippedRoomComesBackAsItWas) {
  const std::string folder = fresh_folder("out") + "/captured";
  NamedDataset room = small(kShipped, {{"frames", "3"}, {"test_frames", "0"}});
  round_trip(room, 3, folder);
  const std::string intrinsics = read_text_file(folder + "/intrinsics.txt");
  EXPECT_EQ(intrinsics.rfind("40 30 20", 0), 0u) << intrinsics;
}

/// Two frames of a wall, with values chosen by the test.
class Wall final : public Dataset {
 public:
  SceneInfo info;
  FrameBuffer frame;
  Wall() {
    info.classes = ClassTable({{0, "plaster", {1, 2, 3}, false}, {1, "brick", {4, 5, 6}, false}});
    frame.width_px = 4;
    frame.height_px = 2;
    frame.rgb.assign(24, 100);
    frame.depth_m.assign(8, 1.5f);
    frame.label.assign(8, 1);
    frame.instance.assign(8, 300);
    for (int i = 0; i < 2; ++i) {
      FrameInfo f{.name = std::to_string(i),
                  .camera = room_camera(4, 2),
                  .world_from_camera = {.t = {0.1 * i, 0, 0}},
                  .has_depth = true,
                  .has_labels = true,
                  .has_instances = true};
      info.frames.push_back(f);
    }
  }
  SceneInfo open(Diagnostics&) override { return info; }
  void read(int, FrameBuffer& out) const override { out = frame; }
};

TEST(Capture, VoidStaysVoidWhereTheTableHasNoVoid) {
  Wall wall;
  wall.frame.label[3] = kVoid;
  wall.frame.label[4] = 0;
  round_trip(wall, 2, fresh_folder("out"));
}

/// The first frame of a capture.
FrameBuffer first_of(const std::string& folder) {
  NamedDataset replica = captured(folder);
  replica.open();
  return replica.read(0);
}

TEST(Capture, DepthIsMended) {
  Wall wall;
  const std::string folder = fresh_folder("out");
  app::capture_replica(wall, wall.info, folder, {}, {.depth_scale = 2});
  EXPECT_NEAR(first_of(folder).depth_m[0], 2 * wall.frame.depth_m[0], 1e-3);
}

TEST(Capture, InstancesBeyondAByteAndDepthBeyondTheRange) {
  Wall wall;
  const std::string folder = fresh_folder("out");
  wall.frame.depth_m[0] = 70;
  wall.frame.depth_m[1] = 65.535f;  // 65535 reads as invalid
  wall.frame.depth_m[2] = 65.534f;
  wall.frame.depth_m[3] = 0;
  app::capture_replica(wall, wall.info, folder);
  const FrameBuffer f = first_of(folder);
  EXPECT_EQ(f.instance, wall.frame.instance);
  EXPECT_EQ(f.depth_m[0], 0);
  EXPECT_EQ(f.depth_m[1], 0);
  EXPECT_NEAR(f.depth_m[2], 65.534, 1e-4);
  EXPECT_EQ(f.depth_m[3], 0);
  wall.frame.instance[0] = 65536;
  EXPECT_HAS(error_of([&] { app::capture_replica(wall, wall.info, fresh_folder("more")); }), "65536", "16");
}

TEST(Capture, ChannelsThatTheSceneLacksAreLeftOut) {
  Wall wall;
  for (FrameInfo& f : wall.info.frames) f.has_depth = f.has_labels = f.has_instances = false;
  wall.info.classes = {};
  wall.frame.depth_m.clear();
  wall.frame.label.clear();
  wall.frame.instance.clear();
  const std::string folder = fresh_folder("out");
  app::capture_replica(wall, wall.info, folder);
  for (const char* name : {"depth", "semantic_class", "semantic_instance", "classes.yaml"})
    EXPECT_FALSE(fs::exists(folder + "/" + name)) << name;
  Diagnostics d;
  const SceneInfo back = captured(folder).open(d);
  EXPECT_EQ(all_said(d), "");
  ASSERT_EQ(back.frames.size(), 2u);
  EXPECT_FALSE(back.frames[0].has_depth || back.frames[0].has_labels || back.frames[0].has_instances);
}

TEST(Capture, RefusesWhatTheLayoutCannotHold) {
  const std::string folder = fresh_folder("out");
  Wall wall;
  wall.info.frames[1].camera.fx += 1;
  wall.info.frames[1].camera.k1 = 0.1;
  EXPECT_HAS(error_of([&] { app::capture_replica(wall, wall.info, folder); }), "frame 1: has lens distortion",
             "frame 1: has another camera");
  EXPECT_TRUE(fs::is_empty(folder));
  wall.info.frames[1] = wall.info.frames[0];
  app::capture_replica(wall, wall.info, folder);
  EXPECT_HAS(error_of([&] { app::capture_replica(wall, wall.info, folder); }), folder, "captured scene");
  wall.info.frames.clear();
  EXPECT_EQ(error_of([&] { app::capture_replica(wall, wall.info, fresh_folder("none")); }), "the scene has no frames");
}

// Cast frames are kept and found again, and never in place of others.

struct CastCacheTest : testing::Test {
  void SetUp() override {
    folder_ = fs::path(testing::TempDir()) / ("cast_cache_" + std::to_string(::getpid()));
    fs::remove_all(folder_);
    ::setenv("SEMFIELD_CACHE", folder_.c_str(), 1);
  }
  void TearDown() override {
    fs::remove_all(folder_);
    ::setenv("SEMFIELD_CACHE", "off", 1);
    ::unsetenv("SEMFIELD_CACHE_GB");
  }

  static std::vector<FrameBuffer> frames(testkit::Settings settings = {}) {
    settings.insert(
        {{"width_px", "24"}, {"height_px", "18"}, {"frames", "2"}, {"test_frames", "1"}, {"occlusion_rays", "1"}});
    NamedDataset room = small(kShipped, settings);
    std::vector<FrameBuffer> all(room.open().frames.size());
    for (std::size_t i = 0; i < all.size(); ++i) all[i] = room.read(static_cast<int>(i));
    return all;
  }
  static void expect_equal(const std::vector<FrameBuffer>& a, const std::vector<FrameBuffer>& b) {
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) expect_same(a[i], b[i]);
  }
  std::vector<fs::path> kept() const {
    std::vector<fs::path> files;
    if (!fs::exists(folder_)) return files;
    for (const auto& entry : fs::recursive_directory_iterator(folder_))
      if (entry.is_regular_file()) files.push_back(entry.path());
    std::sort(files.begin(), files.end());
    return files;
  }

  fs::path folder_;
};

// What is kept is what is read: pictures of one file in the place of another come back as they are.
TEST_F(CastCacheTest, AKeptFrameIsReadAndNotCast) {
  const auto cast = frames();
  const auto files = kept();
  ASSERT_EQ(files.size(), 3U);
  fs::copy_file(files[1], files[0], fs::copy_options::overwrite_existing);
  EXPECT_EQ(frames()[0].rgb, cast[1].rgb);
}

TEST_F(CastCacheTest, ADamagedFileIsCastAgainAndMended) {
  const auto cast = frames();
  for (const fs::path& file : kept()) {
    std::fstream stream(file, std::ios::in | std::ios::out | std::ios::binary);
    stream.seekp(200);
    stream.put('\x55');
    stream.put('\x55');
  }
  fs::resize_file(kept()[2], 100);
  expect_equal(frames(), cast);
  expect_equal(frames(), cast);
  EXPECT_GT(fs::file_size(kept()[2]), 100U);
}

TEST_F(CastCacheTest, WhateverChangesPicturesHasItsOwnPlace) {
  const auto cast = frames();
  for (const auto& [name, value] :
       {std::pair{"exposure", "1.1"}, {"seed", "7"}, {"daylight", "0"}, {"hfov_deg", "70"}, {"occlusion_rays", "4"}}) {
    const std::size_t before = kept().size();
    const auto changed = frames({{name, value}});
    EXPECT_EQ(kept().size(), before + 3);
    EXPECT_NE(changed[0].rgb, cast[0].rgb);
  }
  expect_equal(frames(), cast);
}

TEST_F(CastCacheTest, ATextureThatChangesChangesTheKey) {
  fs::create_directories(folder_);
  const std::string texture = (folder_ / "map.png").string();
  std::ofstream(texture) << "one";
  const std::string before = cast_key("", {texture});
  EXPECT_EQ(cast_key("", {texture}), before);
  std::ofstream(texture) << "two";
  EXPECT_NE(cast_key("", {texture}), before);
}

TEST_F(CastCacheTest, RoomsUnusedForLongestGo) {
  ::setenv("SEMFIELD_CACHE_GB", "0.00000001", 1);  // 10 bytes: only the room in use stays
  (void)frames();
  (void)frames({{"exposure", "1"}});
  EXPECT_EQ(kept().size(), 3U);
  ::setenv("SEMFIELD_CACHE_GB", "0", 1);
  fs::remove_all(folder_);
  (void)frames();
  EXPECT_EQ(kept().size(), 0U);
}

TEST_F(CastCacheTest, NothingIsKeptWhereItIsOffOrCannotBe) {
  ::setenv("SEMFIELD_CACHE", "off", 1);
  EXPECT_EQ(cache_folder("rooms"), "");
  const auto cast = frames();
  EXPECT_EQ(kept().size(), 0U);
  ::setenv("SEMFIELD_CACHE", "/proc/none", 1);
  expect_equal(frames(), cast);
  ::setenv("SEMFIELD_CACHE", folder_.c_str(), 1);
  ::setenv("SEMFIELD_CACHE_GB", "two", 1);
  EXPECT_THROW((void)frames(), Error);
}

}  // namespace
}  // namespace semfield
