// Record3D exports: whose pose is whose, layouts of K, depth of another size, and files that do not fit.
#include <nlohmann/json.hpp>

#include "loading/frame_source.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/image_bytes.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;
using nlohmann::json;

constexpr int kPoses = 13;

// What the app writes of the camera and of frames 0 to 12, whichever are kept.
json metadata() {
  const Camera c = room_camera();
  json poses = json::array();
  for (int i = 0; i < kPoses; ++i) {
    const Pose pose = opencv_from_opengl(room_pose(i));  // the turn is its own inverse
    const Quaternion q = quaternion_of(pose);
    poses.push_back({q[1], q[2], q[3], q[0], pose.t.x, pose.t.y, pose.t.z});
  }
  return {{"w", c.width_px}, {"h", c.height_px}, {"K", {c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1}}, {"poses", poses}};
}

// Colour of 40 x 30 pixels, depth of 20 x 15, of the frames that nobody deleted.
std::string export_of(const json& meta, const std::vector<int>& kept = {0, 3, 10, 12}) {
  static int made = 0;
  const std::string folder = fresh_folder(std::to_string(made++));
  for (const char* part : {"/rgb", "/depth"}) std::filesystem::create_directories(folder + part);
  for (const int i : kept) {
    const std::string name = std::to_string(i);
    write_png_rgb(folder + "/rgb/" + name + ".png", 40, 30, render_room(room_camera(), room_pose(i)).rgb);
    std::vector<float> depth = render_room(room_camera(20, 15), room_pose(i)).depth_m;
    depth[0] = std::nanf("");
    plain_write(folder + "/depth/" + name + ".exr", exr_of(20, 15, depth));
  }
  plain_write(folder + "/metadata.json", meta.dump());
  return folder;
}

SceneInfo open(const std::string& folder, Diagnostics& d) {
  return NamedDataset("record3d", {{"root", folder}}).open(d);
}

std::string first_problem(const json& meta, const std::vector<int>& kept = {0, 3}) {
  Diagnostics d;
  open(export_of(meta, kept), d);
  return d.all().empty() ? "" : d.all()[0].text();
}

TEST(Record3d, PosesGoByTheNumberInTheName) {
  Diagnostics d;
  const SceneInfo info = open(export_of(metadata()), d);
  EXPECT_TRUE(d.all().empty());
  ASSERT_EQ(info.frames.size(), 4u);
  EXPECT_TRUE(info.metric);
  EXPECT_TRUE(info.tracked);
  const int number[] = {0, 3, 10, 12};  // not the order of the names as text
  for (std::size_t k = 0; k < 4; ++k) {
    const FrameInfo& frame = info.frames[k];
    EXPECT_EQ(frame.name, std::to_string(number[k]));
    EXPECT_EQ(frame.split, k == 0 ? Split::test : Split::train);
    const Pose want = room_pose(number[k]);
    EXPECT_LT(length(frame.world_from_camera.t - want.t), 1e-12);
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_LT(length(frame.world_from_camera.axis(axis) - want.axis(axis)), 1e-12) << axis;
    EXPECT_EQ(frame.camera.fx, room_camera().fx);
    EXPECT_EQ(frame.camera.cy, room_camera().cy);
  }
}

TEST(Record3d, DepthOfAnotherSizeIsNeverAveraged) {
  if (!images_available()) GTEST_SKIP() << "this build reads no EXR (SEMFIELD_WITH_IMAGES=OFF)";
  NamedDataset scene("record3d", {{"root", export_of(metadata())}});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  FrameBuffer got;
  scene.read(2, got);
  EXPECT_EQ(got.rgb, render_room(room_camera(), room_pose(10)).rgb);
  const std::vector<float> small = render_room(room_camera(20, 15), room_pose(10)).depth_m;
  ASSERT_EQ(got.depth_m.size(), 1200u);
  EXPECT_EQ(got.depth_m[0], 0.0f) << "no number is no depth";
  for (std::size_t i = 2; i < 1200; ++i) {
    const std::size_t x = i % 40, y = i / 40;
    if (x < 2 && y < 2) continue;
    ASSERT_EQ(got.depth_m[i], small[y / 2 * 20 + x / 2]) << x << ", " << y;
  }
  Diagnostics loading;
  EXPECT_HAS(load_scene(scene, {}, loading).geometry, "poses agree with depth");
}

TEST(Record3d, BothLayoutsOfTheMatrixAndALensForEachFrame) {
  const Camera c = room_camera();
  json by_row = metadata();
  by_row["K"] = {c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1};
  Diagnostics d;
  const Camera told = open(export_of(by_row), d).frames.at(1).camera;
  EXPECT_EQ(told.cx, c.cx);
  EXPECT_EQ(told.cy, c.cy);
  json focus = metadata();
  for (int i = 0; i < kPoses; ++i) focus["perFrameIntrinsicCoeffs"].push_back({100 + i, 200 + i, c.cx, c.cy});
  EXPECT_EQ(open(export_of(focus), d).frames.at(2).camera.fy, 210);
  json large = metadata();
  large["w"] = 80;
  large["h"] = 60;
  large["K"] = {2 * c.fx, 0, 0, 0, 2 * c.fy, 0, 2 * c.cx, 2 * c.cy, 1};
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(open(export_of(large), d).frames.at(0).camera.cx, c.cx);
  EXPECT_HAS(d.all().at(0).text(), "the intrinsics of 4 frames were scaled");
}

TEST(Record3d, WhatDoesNotFitIsNamed) {
  const Camera c = room_camera();
  EXPECT_HAS(first_problem(metadata(), {0, 13}), "has 13 poses, of the frames 0 to 12");
  json meta = metadata();
  meta["K"] = {c.fx, 0, 1, 0, c.fy, 0, c.cx, c.cy, 1};
  EXPECT_HAS(first_problem(meta), "metadata.json: 'K' is not a pinhole camera");
  meta["K"] = {c.fx, 0, 0, 0, c.fy, 0, c.cy, c.cx, 1};  // of the phone held the other way
  EXPECT_HAS(first_problem(meta), "turned by a quarter");
  meta = metadata();
  meta["w"] = c.height_px;
  meta["h"] = c.width_px;
  std::swap(meta["K"][6], meta["K"][7]);
  EXPECT_HAS(first_problem(meta), "one is turned by a quarter against the other");
  meta = metadata();
  meta["poses"][3].erase(0);
  EXPECT_HAS(first_problem(meta), "row 3 of 'poses' is not a list of 7 numbers");
  meta.erase("poses");
  EXPECT_HAS(first_problem(meta), "has no list 'poses'");
  meta = metadata();
  meta.erase("h");
  EXPECT_HAS(first_problem(meta), "states no image size");
  meta = metadata();
  meta["perFrameIntrinsicCoeffs"] = {{1, 2, 3, 4}};
  EXPECT_HAS(first_problem(meta), "has 13 poses and 1 rows of 'perFrameIntrinsicCoeffs'");
  meta = metadata();
  meta["poses"][3][0] = nullptr;
  EXPECT_HAS(first_problem(meta), "1 of 2 frames skipped: their poses are not finite (3)");
  Diagnostics d;
  EXPECT_HAS(error_of([&] { open(fresh_folder("none"), d); }), "rgb' is missing");
}

TEST(Record3d, FramesWithoutDepth) {
  const std::string folder = export_of(metadata());
  std::filesystem::remove(folder + "/depth/3.exr");
  Diagnostics skip;
  NamedDataset scene("record3d", {{"root", folder}, {"missing", "skip"}});
  EXPECT_FALSE(scene.open(skip).frames.at(1).has_depth);
  EXPECT_FALSE(skip.has_errors());
  if (!images_available()) GTEST_SKIP() << "this build reads no EXR (SEMFIELD_WITH_IMAGES=OFF)";
  plain_write(folder + "/depth/3.exr", exr_of(15, 20, std::vector<float>(300, 1.0f)));
  Diagnostics turned;
  open(folder, turned);
  EXPECT_HAS(turned.all().at(0).text(), "is 15 x 20 pixels, the colour image 40 x 30: another aspect ratio");
}

TEST(Record3d, ThePhonesFolderIsRecognised) {
  const std::string folder = export_of(metadata());
  EXPECT_EQ(Recognised("record3d", folder).what, "an export of Record3D");
  const std::string outer = fresh_folder("outer");
  std::filesystem::rename(folder, outer + "/EXR_RGBD");
  const Recognised found("record3d", outer);
  EXPECT_EQ(found.what, "an export of Record3D");
  EXPECT_EQ(found.root, outer + "/EXR_RGBD");
  plain_write(outer + "/EXR_RGBD/metadata.json", "{\"camera\": 1}");
  EXPECT_EQ(Recognised("record3d", outer).what, "");
}

}  // namespace
}  // namespace semfield
