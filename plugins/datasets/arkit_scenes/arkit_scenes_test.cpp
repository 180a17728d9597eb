// Scenes of ARKitScenes: poses by time, their direction, and files that do not fit.
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kFirst = "42_10.000";

// A photograph each at 10.0, 10.1 and 10.2 s; `trajectory` says whose poses there are.
std::string scene_of(const std::string& trajectory) {
  static int made = 0;
  const std::string folder = fresh_folder(std::to_string(made++));
  for (const char* part : {"/lowres_wide", "/lowres_wide_intrinsics", "/lowres_depth"})
    std::filesystem::create_directories(folder + part);
  for (const std::string stem : {kFirst, "42_10.100", "42_10.200"}) {
    write_png_rgb(folder + "/lowres_wide/" + stem + ".png", 4, 2, std::vector<std::uint8_t>(24, 9));
    write_png_gray16(folder + "/lowres_depth/" + stem + ".png", 4, 2, std::vector<std::uint16_t>(8, 1500));
    plain_write(folder + "/lowres_wide_intrinsics/" + stem + ".pincam", "4 2 3 3.5 2 1\n");
  }
  plain_write(folder + "/lowres_wide.traj", trajectory);
  return folder;
}

SceneInfo open(const std::string& folder, Diagnostics& d) {
  return NamedDataset("arkit_scenes", {{"root", folder}}).open(d);
}

// A quarter turn about y, as the file has it: camera from world. A point (1, 0, 0) of the world is (0, 0, -1) + shift.
TEST(ArkitScenes, PosesAreInvertedAndTakenByTime) {
  const std::string quarter = " 0 1.5707963267948966 0 1 2 3\n";
  Diagnostics d;
  const SceneInfo info = open(scene_of("9.9996" + quarter + "10.1 0 0 0 0 0 0\n10.208 0 0 0 5 5 5\n"), d);
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_TRUE(info.tracked);
  EXPECT_FALSE(d.has_errors());
  EXPECT_FINDING(d, "scene.pose.skipped", "1 of 3");
  const Pose& pose = info.frames[0].world_from_camera;
  EXPECT_EQ(info.frames[0].name, kFirst);
  EXPECT_LT(length(pose.apply_inverse({1, 0, 0}) - Vec3d{1, 2, 2}), 1e-12);
  EXPECT_EQ(info.frames[0].camera.fy, 3.5);
  EXPECT_EQ(info.frames[1].world_from_camera.t, (Vec3d{0, 0, 0}));
  EXPECT_TRUE(info.frames[1].has_depth);
}

TEST(ArkitScenes, TimesOfIntrinsicsMayBeOffByAMillisecond) {
  const std::string folder = scene_of("10 0 0 0 0 0 0\n");
  const std::string lens = folder + "/lowres_wide_intrinsics/42_";
  std::filesystem::rename(lens + "10.000.pincam", lens + "9.999.pincam");
  Diagnostics d;
  EXPECT_EQ(open(folder, d).frames.size(), 1u);
  std::filesystem::rename(lens + "9.999.pincam", lens + "9.990.pincam");
  Diagnostics lost;
  open(folder, lost);
  EXPECT_FINDING(lost, "scene.camera.missing", "42_10.000.png");
}

}  // namespace
}  // namespace semfield
