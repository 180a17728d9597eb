// Recordings of Stray Scanner: columns by name, numbers of frames, and files that do not fit.
#include <algorithm>

#include "scene/camera.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kHeader = "timestamp, frame, x, y, z, qx, qy, qz, qw\n";
constexpr const char* kMatrix = "20, 0, 20\n0, 20, 15\n0, 0, 1\n";

std::string row_of(int i, bool with_frame = true) {
  const Pose pose = room_pose(i);
  const Quaternion q = quaternion_of(pose);
  char text[256];
  std::snprintf(text, sizeof text, "%.12g, %.12g, %.12g, %.12g, %.12g, %.12g, %.12g\n", pose.t.x, pose.t.y, pose.t.z,
                q[1], q[2], q[3], q[0]);
  return (with_frame ? "12.5, 00000" + std::to_string(i) + ", " : "") + text;
}

std::string recording_of(const std::string& odometry, const std::string& matrix = kMatrix) {
  static int made = 0;
  const std::string folder = fresh_folder(std::to_string(made++));
  for (const char* part : {"/rgb", "/depth", "/confidence"}) std::filesystem::create_directories(folder + part);
  for (const int i : {0, 3}) {  // every third was taken out of the video
    const std::string name = "00000" + std::to_string(i) + ".png";
    const FrameBuffer half = render_room(room_camera(20, 15), room_pose(i));
    write_png_rgb(folder + "/rgb/" + name, 40, 30, render_room(room_camera(), room_pose(i)).rgb);
    write_png_gray16(folder + "/depth/" + name, 20, 15, mm_of(half));
    write_png_gray8(folder + "/confidence/" + name, 20, 15, std::vector<std::uint8_t>(300, i == 0 ? 0 : 2));
  }
  plain_write(folder + "/odometry.csv", odometry);
  plain_write(folder + "/camera_matrix.csv", matrix);
  return folder;
}

SceneInfo open(const std::string& folder, Diagnostics& d) {
  return NamedDataset("stray_scanner", {{"root", folder}}).open(d);
}

TEST(StrayScanner, PosesGoByTheFramesNumber) {
  const std::string rows = row_of(3) + row_of(0) + row_of(1);
  for (const std::string& odometry : {kHeader + rows, "x, y, z, qx, qy, qz, qw\n" + row_of(0, false) +
                                                          row_of(1, false) + row_of(2, false) + row_of(3, false)}) {
    Diagnostics d;
    const SceneInfo info = open(recording_of(odometry), d);
    EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
    ASSERT_EQ(info.frames.size(), 2u);
    EXPECT_LT(length(info.frames[1].world_from_camera.t - room_pose(3).t), 1e-11);
    EXPECT_LT(length(info.frames[1].world_from_camera.axis(2) - room_pose(3).axis(2)), 1e-11);
    EXPECT_EQ(info.frames[1].camera.cx, 20);
    EXPECT_FALSE(info.opengl_files);
    EXPECT_TRUE(info.tracked);
  }
}

TEST(StrayScanner, DepthOfLowConfidenceCountsAsNone) {
  NamedDataset scene("stray_scanner", {{"root", recording_of(kHeader + row_of(0) + row_of(3))}});
  Diagnostics d;
  scene.open(d);
  FrameBuffer out;
  scene.read(0, out);
  EXPECT_EQ(*std::max_element(out.depth_m.begin(), out.depth_m.end()), 0);
  scene.read(1, out);
  EXPECT_GT(*std::min_element(out.depth_m.begin(), out.depth_m.end()), 0.5F);
}

}  // namespace
}  // namespace semfield
