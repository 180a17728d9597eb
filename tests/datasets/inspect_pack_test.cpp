// inspect and pack over the Replica layout: what a user reads, and that a packed scene is the scene.
#include <gtest/gtest.h>

#include "app/scene/inspect_report.h"
#include "app/scene/pack_scene.h"
#include "datasets/packed/packed.h"
#include "datasets/replica/replica.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

ReplicaParams room_params(const std::string& folder) {
  ReplicaParams p;
  p.root = folder;
  p.train_step = 2;
  p.test_step = 2;
  p.test_offset = 1;
  return p;
}

TEST(Pack, PackedSceneIsTheScene) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  SceneLoadOptions half;
  half.downscale = 2;
  const PackSummary summary = pack_scene(replica, folder + "/room.semfield", half, {}, d);
  EXPECT_EQ(summary.frames, 6);
  EXPECT_EQ(summary.bytes, std::filesystem::file_size(folder + "/room.semfield"));
  Packed packed(PackedParams{"room.semfield"}, DatasetBuild{folder});
  SceneLoadOptions whole;
  whole.with_instances = half.with_instances = true;
  const LoadedScene a = load_scene(replica, half, d), b = load_scene(packed, whole, d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(b.frames.size(), 6u);
  EXPECT_EQ(a.bounds.hi, b.bounds.hi);
  EXPECT_EQ(a.far_m, b.far_m);
  EXPECT_EQ(a.class_pixels, b.class_pixels);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_EQ(a.frames[i].rgb, b.frames[i].rgb);
    EXPECT_EQ(a.frames[i].depth_m, b.frames[i].depth_m);
    EXPECT_EQ(a.frames[i].label, b.frames[i].label);
    EXPECT_EQ(a.frames[i].instance, b.frames[i].instance);
    EXPECT_EQ(a.info.frames[i].split, b.info.frames[i].split);
    EXPECT_EQ(a.info.frames[i].camera.fx, b.info.frames[i].camera.fx);
  }
}

TEST(Pack, WhatIsPackedIsMended) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  SceneLoadOptions options;
  options.convention = {true, true, 0.5, 2};
  (void)pack_scene(replica, folder + "/room.semfield", options, {}, d);
  Packed packed(PackedParams{"room.semfield"}, DatasetBuild{folder});
  options.check_geometry = false;
  const LoadedScene a = load_scene(replica, options, d);
  SceneLoadOptions plain;
  plain.check_geometry = false;
  const LoadedScene b = load_scene(packed, plain, d);
  EXPECT_FALSE(d.has_errors());
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_EQ(a.info.frames[i].world_from_camera.r, b.info.frames[i].world_from_camera.r);
    EXPECT_EQ(a.info.frames[i].world_from_camera.t, b.info.frames[i].world_from_camera.t);
    EXPECT_EQ(a.frames[i].depth_m, b.frames[i].depth_m);
  }
  EXPECT_EQ(a.bounds.lo, b.bounds.lo);
  EXPECT_EQ(a.far_m, b.far_m);
}

TEST(Inspect, NamesThePresetThatSuitsTheCameras) {
  LoadedScene scene;
  const auto says = [&](const std::string& text) { return inspect_report(scene, {}).find(text) != std::string::npos; };
  EXPECT_FALSE(says("preset"));  // nothing was loaded
  scene.bounds = {{-1, -1, -1}, {1, 1, 1}};
  EXPECT_TRUE(says("preset      parts/hash_room.yaml:"));
  scene.rig.inward = true;
  EXPECT_TRUE(says("preset      parts/unbounded.yaml:"));
  scene.plain_background = PlainBackground{{255, 255, 255}, scene.bounds};
  EXPECT_TRUE(
      says("preset      parts/object.yaml: the cameras stand around an object before one colour, (255, 255, 255)"));
  scene.plain_background->color = {0, 51, 255};
  EXPECT_TRUE(says("preset      parts/object.yaml with rendering.background: [0, 0.2, 1]:"));
  scene.info.frames.resize(1);
  scene.frames.resize(1);
  scene.class_pixels.resize(1);
  scene.info.frames[0].has_depth = true;
  scene.plain_background.reset();
  EXPECT_TRUE(says("preset      parts/hash_room.yaml: depth images show where the scene ends"));
  const app::Json json = inspect_json(scene, {});
  EXPECT_EQ(json.at("preset"), "parts/hash_room.yaml");
  EXPECT_EQ(json.at("preset_why"), "depth images show where the scene ends");
}

TEST(Inspect, ReportTellsFramesClassesAndProblems) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  cut(folder + "/rgb/rgb_3.png", 20);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  const LoadedScene scene = load_scene(replica, {}, d);
  const std::string report = inspect_report(scene, d);
  EXPECT_NE(report.find("frames      6 (3 train, 3 test), 5 read, 6 with depth\n"), std::string::npos) << report;
  EXPECT_NE(report.find("size        40 x 30 (6 frames)\n"), std::string::npos) << report;
  EXPECT_NE(report.find("bounds      ("), std::string::npos);
  EXPECT_NE(report.find(" from depth of 3 training frames\n"), std::string::npos) << report;
  EXPECT_NE(report.find("near, far   0.1, 10 from the dataset\n"), std::string::npos) << report;
  EXPECT_NE(report.find("labelled frames: 3 train, 2 test"), std::string::npos) << report;
  EXPECT_NE(report.find("north"), std::string::npos);
  EXPECT_NE(report.find("3 of 3"), std::string::npos);
  EXPECT_NE(report.find("error       frame 'rgb_3' (" + folder + "/rgb/rgb_3.png): '" + folder +
                        "/rgb/rgb_3.png': PNG is truncated"),
            std::string::npos)
      << report;
}

TEST(Inspect, FrustaFileHasTheStatedSize) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 4);
  Replica replica(room_params(folder), {});
  Diagnostics d;
  const LoadedScene scene = load_scene(replica, {}, d);
  write_frusta_ply(folder + "/cameras.ply", scene);
  const std::string file = read_text_file(folder + "/cameras.ply");
  const std::size_t body = file.find("end_header\n") + 11;
  EXPECT_NE(file.find("element vertex 20\n"), std::string::npos);
  EXPECT_EQ(file.size() - body, 20u * 15 + 4u * (4 * 13 + 17));
}

}  // namespace
}  // namespace semfield
