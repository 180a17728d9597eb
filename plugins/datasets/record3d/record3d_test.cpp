// Depth of Record3D exports, which is EXR. Poses, lens and refusals: tests/bad_files/indexes.cases.
#include <nlohmann/json.hpp>

#include "scene/camera.h"
#include "scene/loading/frame_source.h"
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
std::string export_of() {
  const std::string folder = fresh_folder("r");
  for (const char* part : {"/rgb", "/depth"}) std::filesystem::create_directories(folder + part);
  for (const int i : {0, 3, 10, 12}) {
    const std::string name = std::to_string(i);
    write_png_rgb(folder + "/rgb/" + name + ".png", 40, 30, render_room(room_camera(), room_pose(i)).rgb);
    std::vector<float> depth = render_room(room_camera(20, 15), room_pose(i)).depth_m;
    depth[0] = std::nanf("");
    plain_write(folder + "/depth/" + name + ".exr", exr_of(20, 15, depth));
  }
  plain_write(folder + "/metadata.json", metadata().dump());
  return folder;
}

TEST(Record3d, DepthOfAnotherSizeIsNeverAveraged) {
  if (!images_available()) GTEST_SKIP() << "this build reads no EXR (SEMFIELD_WITH_IMAGES=OFF)";
  NamedDataset scene("record3d", {{"root", export_of()}});
  scene.open();
  const FrameBuffer got = scene.read(2);
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

TEST(Record3d, FramesWithoutDepth) {
  const std::string folder = export_of();
  std::filesystem::remove(folder + "/depth/3.exr");
  EXPECT_FALSE(NamedDataset("record3d", {{"root", folder}, {"missing", "skip"}}).open().frames.at(1).has_depth);
  if (!images_available()) GTEST_SKIP() << "this build reads no EXR (SEMFIELD_WITH_IMAGES=OFF)";
  plain_write(folder + "/depth/3.exr", exr_of(15, 20, std::vector<float>(300, 1.0f)));
  Diagnostics turned;
  NamedDataset("record3d", {{"root", folder}}).open(turned);
  EXPECT_HAS(turned.all().at(0).text(), "is 15 x 20 pixels, the colour image 40 x 30: another aspect ratio");
}

}  // namespace
}  // namespace semfield
