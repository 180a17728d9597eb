// The datasets on real scenes, where they are at hand.
#include "datasets/colmap/colmap.h"
#include "datasets/llff/llff.h"
#include "datasets/record3d/record3d.h"
#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "loading/frame_source.h"
#include "tests/datasets/rewritten_poses.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

TEST(RealData, ReplicaApartment) {
  if (!std::filesystem::exists(data("replica_apartment0")))
    GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p{.root = data("replica_apartment0"), .train_step = 2, .test_step = 2, .test_offset = 1};
  Replica replica(p, {});
  Diagnostics d;
  SceneLoadOptions o{.width_px = 160};
  const LoadedScene s = load_scene(replica, o, d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  EXPECT_EQ(s.frames_of(Split::train).size(), 35u);
  EXPECT_EQ(s.frames_of(Split::test).size(), 35u);
  EXPECT_NEAR(s.info.frames[0].camera.fx, 80.0, 1e-9);
  EXPECT_NEAR(s.info.frames[0].camera.cx, 80.0, 1e-9);  // 159.5 with integer centres
  EXPECT_FALSE(s.bounds.empty());
  EXPECT_LT(length(s.bounds.size()), 40.0);
}

TEST(RealData, StudioRoomPhotographs) {
  if (!std::filesystem::exists(data("studio_room"))) GTEST_SKIP() << "the optional studio photographs are not at hand";
  TransformsJsonParams p{.root = data("studio_room")};
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 35u);
  EXPECT_EQ(info.frames[0].name, "0017");
  EXPECT_EQ(info.frames[0].camera.width_px, 960);
  EXPECT_FALSE(info.metric);
  EXPECT_NEAR(info.frames[0].world_from_camera.axis(2).x, -0.8959027551102706, 1e-9);
  FrameBuffer f;
  scene.read(0, f);
  EXPECT_EQ(f.rgb.size(), 960u * 540 * 3);
}

// The two exports of one reconstruction agree up to a similarity: x' = s Q x + t.
TEST(RealData, StudioRoomByColmapAndByTransforms) {
  if (!std::filesystem::exists(data("studio_room"))) GTEST_SKIP() << "the optional studio photographs are not at hand";
  TransformsJsonParams pt;
  ColmapParams pc;
  pt.root = pc.root = data("studio_room");
  TransformsJson by_json(pt, {});
  Colmap by_colmap(pc, {});
  Diagnostics d;
  const SceneInfo json = by_json.open(d), colmap = by_colmap.open(d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  ASSERT_EQ(colmap.frames.size(), 35u);
  std::map<std::string, const FrameInfo*> other;
  for (const FrameInfo& f : json.frames) other[f.name] = &f;
  const FrameInfo &a = colmap.frames[0], &b = *other.at(a.name);
  const Vec3d a_far = colmap.frames[20].world_from_camera.t - a.world_from_camera.t;
  const double scale =
      length(other.at(colmap.frames[20].name)->world_from_camera.t - b.world_from_camera.t) / length(a_far);
  const auto turned = [&](Vec3d v) { return b.world_from_camera.rotate(a.world_from_camera.unrotate(v)); };  // Q
  for (const FrameInfo& f : colmap.frames) {
    const FrameInfo& g = *other.at(f.name);
    EXPECT_EQ(f.split, g.split) << f.name;
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_LT(length(turned(f.world_from_camera.axis(axis)) - g.world_from_camera.axis(axis)), 1e-6) << f.name;
    const Vec3d moved = turned(f.world_from_camera.t - a.world_from_camera.t) * scale + b.world_from_camera.t;
    EXPECT_LT(length(moved - g.world_from_camera.t), 1e-6) << f.name;
    // The model is of images twice as large.
    EXPECT_EQ(f.camera.width_px, 960);
    EXPECT_NEAR(f.camera.fx, g.camera.fx, 1e-9);
    EXPECT_NEAR(f.camera.fy, g.camera.fy, 1e-9);
    EXPECT_NEAR(f.camera.cx, g.camera.cx, 1e-9);
    EXPECT_NEAR(f.camera.cy, g.camera.cy, 1e-9);
    EXPECT_EQ(f.camera.k2, g.camera.k2);
    EXPECT_EQ(f.camera.p1, g.camera.p1);
  }
  EXPECT_FALSE(colmap.bounds.empty());
}

TEST(RealData, LlffAndTransformsOfOneSceneAgree) {
  if (!std::filesystem::exists(data("llff_room"))) GTEST_SKIP() << "the optional scene llff_room is not at hand";
  TransformsJsonParams pt;
  LlffParams pl;
  pt.root = pl.root = data("llff_room");
  TransformsJson by_json(pt, {});
  Llff by_llff(pl, {});
  Diagnostics d;
  const SceneInfo json = by_json.open(d), llff = by_llff.open(d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  ASSERT_EQ(json.frames.size(), llff.frames.size());
  for (std::size_t i = 0; i < json.frames.size(); ++i) {
    const FrameInfo &a = json.frames[i], &b = llff.frames[i];
    EXPECT_EQ(a.name, b.name);
    EXPECT_EQ(a.split, b.split);
    EXPECT_NEAR(a.camera.fx, b.camera.fx, 1e-3);
    EXPECT_EQ(a.camera.cy, b.camera.cy);
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_LT(length(a.world_from_camera.axis(axis) - b.world_from_camera.axis(axis)), 1e-5) << a.name;
    EXPECT_LT(length(a.world_from_camera.t - b.world_from_camera.t), 1e-5) << a.name;
  }
}

TEST(RealData, Record3dDoor) {
  if (!std::filesystem::exists(data("record3d_door")))
    GTEST_SKIP() << "the optional recording of a phone is not at hand";
  Record3d phone(Record3dParams{{.root = data("record3d_door")}}, {});
  Diagnostics d;
  const LoadedScene s = load_scene(phone, {.width_px = 240}, d);
  // The tracker's poses do not fit the photographs; nothing else is wrong.
  for (const Diagnostic& x : d.all())
    EXPECT_TRUE(x.severity == Severity::note || x.code == "scene.camera.off") << x.text();
  EXPECT_TRUE(s.cameras_are_off());
  ASSERT_EQ(s.info.frames.size(), 86u);
  EXPECT_EQ(s.frames_of(Split::test).size(), 11u);
  EXPECT_EQ(s.info.frames[1].name, "4");
  EXPECT_EQ(s.info.frames.back().name, "344");  // the last of 345 poses, of 341 frames that were exported
  EXPECT_HAS(s.geometry, "poses agree with depth");
}

TEST(RealData, ShelfBinWithDepthAndLabels) {
  if (!std::filesystem::exists(data("shelf_bin"))) GTEST_SKIP() << "the optional shelf bin is not at hand";
  TransformsJsonParams p{.root = data("shelf_bin"), .test_every = 5};
  TransformsJson scene(p, {});
  Diagnostics d;
  const LoadedScene s = load_scene(scene, {}, d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(s.frames_of(Split::test).size(), 3u);
  EXPECT_EQ(s.info.classes.valid_count(), 4);
  EXPECT_TRUE(s.info.metric);
  std::int64_t labelled = 0;
  for (const auto& counts : s.class_pixels) labelled += counts[0] + counts[1] + counts[2] + counts[3];
  EXPECT_GT(labelled, 10000);
  EXPECT_HAS(s.bounds_from, "view cones");
}

TEST(RealData, ReplicaConventionsAreTold) {
  if (!std::filesystem::exists(data("replica_apartment0")))
    GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p{.root = data("replica_apartment0"), .train_step = 2, .test_step = 2, .test_offset = 1};
  Replica replica(p, {});
  expect_conventions_told(replica, "poses agree with depth");
}

TEST(RealData, StudioRoomConventionsAreToldFromPhotographs) {
  if (!std::filesystem::exists(data("studio_room"))) GTEST_SKIP() << "the optional studio photographs are not at hand";
  TransformsJsonParams pt;
  ColmapParams pc;
  pt.root = pc.root = data("studio_room");
  TransformsJson by_json(pt, {});
  expect_conventions_told(by_json, "poses agree with the photographs");
  Colmap by_colmap(pc, {});
  expect_conventions_told(by_colmap, "poses agree with the photographs");
}

TEST(RealData, ShelfBinConventionsAreToldFromSparseDepth) {
  if (!std::filesystem::exists(data("shelf_bin"))) GTEST_SKIP() << "the optional shelf bin is not at hand";
  TransformsJsonParams p{.root = data("shelf_bin")};
  TransformsJson scene(p, {});
  expect_conventions_told(scene, "poses agree with depth");
}

}  // namespace
}  // namespace semfield
