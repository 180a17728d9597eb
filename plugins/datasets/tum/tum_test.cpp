// Recordings in the layout of the TUM RGB-D benchmark: times that differ, poses between others, and lines that do not
// fit.
#include "scene/camera.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kImages = "# images\n10.00 rgb/a.png\n10.10  rgb/b.png\n";
constexpr const char* kDepths = "10.101 depth/b.png\n10.005 depth/a.png\n";

std::string row_at(const char* time, const Pose& pose, double sign = 1) {
  const Quaternion q = quaternion_of(pose);
  char text[256];
  std::snprintf(text, sizeof text, "%s %.12g %.12g %.12g %.12g %.12g %.12g %.12g\n", time, pose.t.x, pose.t.y, pose.t.z,
                sign * q[1], sign * q[2], sign * q[3], sign * q[0]);
  return text;
}

std::string usual_poses() { return row_at("10.00", room_pose(0)) + row_at("10.10", room_pose(3)); }

std::string recording_of(const std::string& poses, const std::string& images = kImages,
                         const std::string& name = "recording") {
  static int made = 0;
  const std::string folder = fresh_folder(std::to_string(made++)) + "/" + name;
  for (const char* part : {"/rgb", "/depth"}) std::filesystem::create_directories(folder + part);
  for (const auto& [image, i] : {std::pair{"a", 0}, {"b", 3}}) {
    const FrameBuffer frame = render_room(room_camera(), room_pose(i));
    std::vector<std::uint16_t> steps = mm_of(frame);
    for (std::uint16_t& v : steps) v = static_cast<std::uint16_t>(5 * v);
    write_png_rgb(folder + "/rgb/" + image + ".png", 40, 30, frame.rgb);
    write_png_gray16(folder + "/depth/" + image + ".png", 40, 30, steps);
  }
  plain_write(folder + "/rgb.txt", images);
  plain_write(folder + "/depth.txt", kDepths);
  plain_write(folder + "/groundtruth.txt", poses);
  return folder;
}

NamedDataset scene_of(const std::string& folder, const std::string& lens = "20,20,19.5,14.5") {
  return NamedDataset("tum", {{"root", folder}, {"lens", lens}});
}

SceneInfo open(const std::string& folder, Diagnostics& d) { return scene_of(folder).open(d); }

TEST(Tum, ReadsWhatTheListsName) {
  Diagnostics d;
  NamedDataset scene = scene_of(recording_of(usual_poses()));
  const SceneInfo info = scene.open(d);
  EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_LT(length(info.frames[1].world_from_camera.t - room_pose(3).t), 1e-11);
  EXPECT_LT(length(info.frames[1].world_from_camera.axis(2) - room_pose(3).axis(2)), 1e-11);
  EXPECT_EQ(info.frames[0].camera.cx, 20);
  EXPECT_FALSE(info.tracked);
  FrameBuffer out;
  scene.read(1, out);
  const FrameBuffer want = render_room(room_camera(), room_pose(3));
  ASSERT_EQ(out.depth_m.size(), want.depth_m.size());
  for (std::size_t i = 0; i < want.depth_m.size(); ++i) EXPECT_NEAR(out.depth_m[i], want.depth_m[i], 1e-3);
}

TEST(Tum, APoseBetweenTwoOthersIsTheirMean) {
  // The second quaternion has the other sign: it is the same turn.
  Pose ahead = room_pose(0);
  ahead.t = ahead.t + Vec3d{0.1, 0, 0};
  const std::string poses = row_at("9.99", room_pose(0)) + row_at("10.01", ahead, -1) + row_at("10.10", room_pose(3));
  Diagnostics d;
  const SceneInfo info = open(recording_of(poses), d);
  ASSERT_EQ(info.frames.size(), 2u);
  const Pose& found = info.frames[0].world_from_camera;
  EXPECT_LT(length(found.t - (room_pose(0).t + Vec3d{0.05, 0, 0})), 1e-9);
  EXPECT_LT(length(found.axis(0) - room_pose(0).axis(0)), 1e-9);
}

TEST(Tum, TheFolderNamesTheCamera) {
  Diagnostics d;
  for (const auto& [name, fx] :
       {std::pair{"rgbd_dataset_freiburg1_xyz", 517.3}, {"rgbd_dataset_freiburg3_office", 535.4}, {"mine", 525.0}}) {
    NamedDataset scene = scene_of(recording_of(usual_poses(), kImages, name), "");
    EXPECT_NEAR(scene.open(d).frames.at(0).camera.fx, fx / 16, 1e-9) << name << ": of 640 pixels, and these are 40";
  }
}

// One image would train and be held out, and of two poses one would win.
TEST(Tum, OneThingTwiceIsRefused) {
  Diagnostics d;
  open(recording_of(usual_poses(), "10.00 rgb/a.png\n10.05 rgb/b.png\n10.10 ./rgb/a.png\n"), d);
  EXPECT_FINDING(d, "scene.frame.twice", "rgb.txt:3", "rgb.txt:1");
  const std::string depths = recording_of(usual_poses());
  plain_write(depths + "/depth.txt", "10.0 depth/a.png\n10.0 depth/b.png\n");
  EXPECT_ERROR(open(depths, d), "scene.index.twice", "depth.txt:2", "depth.txt:1");
}

TEST(Tum, NamesWithBackslashesAreRead) {
  Diagnostics d;
  const std::string folder = recording_of(usual_poses(), "10.00 rgb\\a.png\n10.10 .\\rgb\\b.png\n");
  plain_write(folder + "/depth.txt", "10.101 depth\\b.png\n10.005 depth\\a.png\n");
  const SceneInfo info = open(folder, d);
  EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[1].name, "b");
  EXPECT_TRUE(info.frames[1].has_depth);
  EXPECT_TRUE(info.metric);
}

// Bad lines of the lists: tests/bad_files/indexes.cases.
TEST(Tum, WhatDoesNotFitIsNamed) {
  Diagnostics d;
  open(recording_of(row_at("10.00", room_pose(0))), d);
  EXPECT_FINDING(d, "scene.pose.count", "groundtruth.txt", "1 of 2 images");
  EXPECT_ERROR(open(recording_of(row_at("99.0", room_pose(0))), d), "scene.pose.count", "within 20 ms");
  EXPECT_ERROR(scene_of("x", "1,2"), "scene.camera.format", "lens", "2 numbers");
}

}  // namespace
}  // namespace semfield
