// A captured room is the room, every channel through the Replica layout and back; cast frames are kept and found again.
#include <algorithm>
#include <cstdlib>

#include "app/scene/capture_replica.h"
#include "core/error.h"
#include "datasets/obj_room/mesh_render.h"
#include "datasets/obj_room/obj_room.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "datasets/replica/replica.h"
#include "plugin/loader.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

using namespace testing_obj;
namespace fs = std::filesystem;

template <class Params>
std::unique_ptr<Dataset> linked(const std::string& name, const Params& params) {
  static const Registry registry = [] {
    Registry all;
    register_linked_plugins(all);
    return all;
  }();
  ParamsOf<Params> erased;
  erased.value = params;
  return registry.get(PluginKind::dataset, name).dataset(erased, {});
}

ReplicaParams all_frames(const std::string& root) {
  return ReplicaParams{.root = root, .train_step = 1, .test_step = 0};
}

/// Captures what `source` gives, opens it as Replica frames and compares.
void round_trip(Dataset& source, int frames, const std::string& folder) {
  Diagnostics d;
  const SceneInfo info = source.open(d);
  std::vector<int> progress;
  const CaptureReport report = capture_replica(source, info, folder, [&](int done, int total) {
    EXPECT_EQ(total, frames);
    progress.push_back(done);
  });
  EXPECT_EQ(report.frames, frames);
  EXPECT_EQ(static_cast<int>(progress.size()), frames);
  EXPECT_EQ(report.depth_clipped, 0);
  EXPECT_GT(report.bytes, 500);

  const std::unique_ptr<Dataset> replica = linked("replica", all_frames(folder));
  const SceneInfo back = replica->open(d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
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
    FrameBuffer fa, fb;
    source.read(i, fa);
    replica->read(i, fb);
    EXPECT_EQ(fa.rgb, fb.rgb);
    EXPECT_EQ(fa.label, fb.label);
    EXPECT_EQ(fa.instance, fb.instance);
    ASSERT_EQ(fa.depth_m.size(), fb.depth_m.size());
    for (std::size_t k = 0; k < fa.depth_m.size(); ++k) ASSERT_NEAR(fa.depth_m[k], fb.depth_m[k], 0.000501);
  }
}

TEST(Capture, ShippedRoomComesBackAsItWas) {
  ObjRoomParams p{.root = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room",
                  .width_px = 40,
                  .height_px = 30,
                  .frames = 3,
                  .test_frames = 0,
                  .supersample = 1,
                  .occlusion_rays = 2};
  const std::string folder = fresh_folder("out") + "/captured";
  round_trip(*linked("obj_room", p), 3, folder);
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
                  .camera = camera_of(4, 2),
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

TEST(Capture, DepthIsMended) {
  Wall wall;
  const std::string folder = fresh_folder("out");
  capture_replica(wall, wall.info, folder, {}, {.depth_scale = 2});
  Diagnostics d;
  const std::unique_ptr<Dataset> replica = linked("replica", all_frames(folder));
  replica->open(d);
  FrameBuffer f;
  replica->read(0, f);
  EXPECT_NEAR(f.depth_m[0], 2 * wall.frame.depth_m[0], 1e-3);
}

TEST(Capture, InstancesBeyondAByteAndDepthBeyondTheRange) {
  Wall wall;
  const std::string folder = fresh_folder("out");
  wall.frame.depth_m[0] = 70;
  wall.frame.depth_m[1] = 65.535f;  // 65535 reads as invalid
  wall.frame.depth_m[2] = 65.534f;
  wall.frame.depth_m[3] = 0;
  const CaptureReport report = capture_replica(wall, wall.info, folder);
  EXPECT_EQ(report.depth_clipped, 4);  // two frames
  Diagnostics d;
  const std::unique_ptr<Dataset> replica = linked("replica", all_frames(folder));
  replica->open(d);
  FrameBuffer f;
  replica->read(0, f);
  EXPECT_EQ(f.instance, wall.frame.instance);
  EXPECT_EQ(f.depth_m[0], 0);
  EXPECT_EQ(f.depth_m[1], 0);
  EXPECT_NEAR(f.depth_m[2], 65.534, 1e-4);
  EXPECT_EQ(f.depth_m[3], 0);
  wall.frame.instance[0] = 65536;
  EXPECT_EQ(error_of([&] { capture_replica(wall, wall.info, fresh_folder("more")); }),
            "frame 0: instance 65536 does not fit 16 bits");
}

TEST(Capture, ChannelsThatTheSceneLacksAreLeftOut) {
  Wall wall;
  for (FrameInfo& f : wall.info.frames) f.has_depth = f.has_labels = f.has_instances = false;
  wall.info.classes = {};
  wall.frame.depth_m.clear();
  wall.frame.label.clear();
  wall.frame.instance.clear();
  const std::string folder = fresh_folder("out");
  capture_replica(wall, wall.info, folder);
  for (const char* name : {"depth", "semantic_class", "semantic_instance", "classes.yaml"})
    EXPECT_FALSE(fs::exists(folder + "/" + name)) << name;
  Diagnostics d;
  const SceneInfo back = linked("replica", all_frames(folder))->open(d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  ASSERT_EQ(back.frames.size(), 2u);
  EXPECT_FALSE(back.frames[0].has_depth || back.frames[0].has_labels || back.frames[0].has_instances);
}

TEST(Capture, RefusesWhatTheLayoutCannotHold) {
  const std::string folder = fresh_folder("out");
  Wall wall;
  wall.info.frames[1].camera.fx += 1;
  wall.info.frames[1].camera.k1 = 0.1;
  EXPECT_EQ(error_of([&] { capture_replica(wall, wall.info, folder); }),
            "the scene does not fit the Replica layout\nframe 1: has lens distortion; undistort the images "
            "first\nframe 1: has "
            "another camera than frame 0; the layout has one camera for all");
  EXPECT_TRUE(fs::is_empty(folder));
  wall.info.frames[1] = wall.info.frames[0];
  capture_replica(wall, wall.info, folder);
  EXPECT_EQ(error_of([&] { capture_replica(wall, wall.info, folder); }),
            "'" + folder + "' already holds a captured scene; choose another folder or remove it");
  wall.info.frames.clear();
  EXPECT_EQ(error_of([&] { capture_replica(wall, wall.info, fresh_folder("none")); }), "the scene has no frames");
}

// Cast frames are kept and found again, and never in place of others.

class CastCacheTest : public testing::Test {
 protected:
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

  static ObjRoomParams params() {
    return ObjRoomParams{.root = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room",
                         .width_px = 24,
                         .height_px = 18,
                         .frames = 2,
                         .test_frames = 1,
                         .supersample = 1,
                         .occlusion_rays = 1,
                         .shadow_rays = 1};
  }
  static std::vector<FrameBuffer> frames(const ObjRoomParams& p) {
    ObjRoom room(p, {});
    Diagnostics diagnostics;
    const SceneInfo info = room.open(diagnostics);
    std::vector<FrameBuffer> all(info.frames.size());
    for (std::size_t i = 0; i < all.size(); ++i) room.read(static_cast<int>(i), all[i]);
    return all;
  }
  static void expect_equal(const std::vector<FrameBuffer>& a, const std::vector<FrameBuffer>& b) {
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) {
      EXPECT_EQ(a[i].rgb, b[i].rgb);
      EXPECT_EQ(a[i].depth_m, b[i].depth_m);
      EXPECT_EQ(a[i].label, b[i].label);
      EXPECT_EQ(a[i].instance, b[i].instance);
    }
  }
  std::vector<fs::path> kept() const {
    std::vector<fs::path> files;
    if (!fs::exists(folder_)) return files;
    for (const auto& entry : fs::recursive_directory_iterator(folder_)) {
      if (entry.is_regular_file()) files.push_back(entry.path());
    }
    std::sort(files.begin(), files.end());
    return files;
  }

  fs::path folder_;
};

TEST_F(CastCacheTest, FramesComeBackBitForBit) {
  const auto cast = frames(params());
  ASSERT_EQ(kept().size(), 3U);
  const auto written = fs::last_write_time(kept()[0]);
  expect_equal(frames(params()), cast);
  EXPECT_EQ(kept().size(), 3U);
  EXPECT_EQ(fs::last_write_time(kept()[0]), written) << "was cast again";
}

// What is kept is what is read: pictures of one file in the place of another come back as they are.
TEST_F(CastCacheTest, AKeptFrameIsReadAndNotCast) {
  const auto cast = frames(params());
  const auto files = kept();
  ASSERT_EQ(files.size(), 3U);
  fs::copy_file(files[1], files[0], fs::copy_options::overwrite_existing);
  EXPECT_EQ(frames(params())[0].rgb, cast[1].rgb);
}

TEST_F(CastCacheTest, ADamagedFileIsCastAgainAndMended) {
  const auto cast = frames(params());
  for (const fs::path& file : kept()) {
    std::fstream stream(file, std::ios::in | std::ios::out | std::ios::binary);
    stream.seekp(200);
    stream.put('\x55');
    stream.put('\x55');
  }
  fs::resize_file(kept()[2], 100);
  expect_equal(frames(params()), cast);
  expect_equal(frames(params()), cast);
  EXPECT_GT(fs::file_size(kept()[2]), 100U);
}

TEST_F(CastCacheTest, WhateverChangesPicturesHasItsOwnPlace) {
  const auto cast = frames(params());
  int others = 0;
  const auto differs = [&](const auto& change) {
    ObjRoomParams p = params();
    change(p);
    const std::size_t before = kept().size();
    const auto changed = frames(p);
    EXPECT_EQ(kept().size(), before + 3);
    EXPECT_NE(changed[0].rgb, cast[0].rgb);
    ++others;
  };
  differs([](ObjRoomParams& p) { p.exposure = 1.1; });
  differs([](ObjRoomParams& p) { p.seed = 7; });
  differs([](ObjRoomParams& p) { p.daylight = 0; });
  differs([](ObjRoomParams& p) { p.hfov_deg = 70; });
  differs([](ObjRoomParams& p) { p.occlusion_rays = 4; });
  EXPECT_EQ(others, 5);
  expect_equal(frames(params()), cast);
}

TEST_F(CastCacheTest, ATextureThatChangesChangesTheKey) {
  fs::create_directories(folder_);
  const std::string texture = (folder_ / "map.png").string();
  std::ofstream(texture) << "one";
  TriangleMesh mesh;
  mesh.materials.resize(1);
  mesh.materials[0].diffuse_map = texture;
  const std::string before = cast_key(mesh, {}, {});
  EXPECT_EQ(cast_key(mesh, {}, {}), before);
  std::ofstream(texture) << "two";
  EXPECT_NE(cast_key(mesh, {}, {}), before);
}

TEST_F(CastCacheTest, RoomsUnusedForLongestGo) {
  ::setenv("SEMFIELD_CACHE_GB", "0.00000001", 1);  // 10 bytes: only the room in use stays
  (void)frames(params());
  ObjRoomParams other = params();
  other.exposure = 1;
  (void)frames(other);
  EXPECT_EQ(kept().size(), 3U);
  ::setenv("SEMFIELD_CACHE_GB", "0", 1);
  fs::remove_all(folder_);
  (void)frames(params());
  EXPECT_EQ(kept().size(), 0U);
}

TEST_F(CastCacheTest, NothingIsKeptWhereItIsOffOrCannotBe) {
  ::setenv("SEMFIELD_CACHE", "off", 1);
  EXPECT_EQ(cache_folder("rooms"), "");
  const auto cast = frames(params());
  EXPECT_EQ(kept().size(), 0U);
  ::setenv("SEMFIELD_CACHE", "/proc/none", 1);
  expect_equal(frames(params()), cast);
  ::setenv("SEMFIELD_CACHE", folder_.c_str(), 1);
  ::setenv("SEMFIELD_CACHE_GB", "two", 1);
  EXPECT_THROW((void)frames(params()), Error);
}

}  // namespace
}  // namespace semfield
