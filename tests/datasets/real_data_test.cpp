// The datasets on real scenes, where they are at hand.
#include <gtest/gtest.h>

#include "datasets/replica/replica.h"
#include "datasets/transforms_json/transforms_json.h"
#include "scene/frame_source.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

TEST(RealData, ReplicaApartment) {
  if (!std::filesystem::exists(data("replica_apartment0")))
    GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p;
  p.root = data("replica_apartment0");
  p.train_step = 2;
  p.test_step = 2;
  p.test_offset = 1;
  Replica replica(p, {});
  Diagnostics d;
  SceneLoadOptions o;
  o.width_px = 160;
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
  TransformsJsonParams p;
  p.root = data("studio_room");
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

TEST(RealData, ShelfBinWithDepthAndLabels) {
  if (!std::filesystem::exists(data("shelf_bin"))) GTEST_SKIP() << "the optional shelf bin is not at hand";
  TransformsJsonParams p;
  p.root = data("shelf_bin");
  p.test_every = 5;
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
  EXPECT_NE(s.bounds_from.find("view cones"), std::string::npos);
}

}  // namespace
}  // namespace semfield
