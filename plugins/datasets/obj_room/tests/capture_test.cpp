// A captured room is the room: every channel through the Replica layout and back.
#include <gtest/gtest.h>

#include "app/scene/capture_replica.h"
#include "datasets/obj_room/obj_room.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "datasets/replica/replica.h"
#include "plugin/linked_plugins.h"

namespace semfield {
namespace {

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
  ReplicaParams p;
  p.root = root;
  p.train_step = 1;
  p.test_step = 0;
  return p;
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
    const FrameInfo &a = info.frames[static_cast<std::size_t>(i)], &b = back.frames[static_cast<std::size_t>(i)];
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
  ObjRoomParams p;
  p.root = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room";
  p.width_px = 40;
  p.height_px = 30;
  p.frames = 3;
  p.test_frames = 0;
  p.supersample = 1;
  p.occlusion_rays = 2;
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
      FrameInfo f;
      f.name = std::to_string(i);
      f.camera = camera_of(4, 2);
      f.world_from_camera.t = {0.1 * i, 0, 0};
      f.has_depth = f.has_labels = f.has_instances = true;
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
  for (const char* name : {"depth", "semantic_class", "semantic_instance", "classes.yaml"}) {
    EXPECT_FALSE(fs::exists(folder + "/" + name)) << name;
  }
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

}  // namespace
}  // namespace semfield
