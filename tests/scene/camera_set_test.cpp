// Cameras as a file: what was written is read to the bit, and what cannot be a camera is refused by its number.
#include "scene/camera_set.h"

#include <gtest/gtest.h>

#include "scene/camera_path.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;
using testing_room::plain_write;

CameraSet two_cameras() {
  CameraSet set;
  const Pose pose = look_along({1.0 / 3, -2e-7, 1e5 / 7}, {0.3, 0.7, -0.1}, {0, 0, 1});
  set.cameras.push_back({"rgb/0001",
                         {640, 480, 500.1, 501.0 / 3, 320.5, 239.7, 0.1, -0.02, 1e-3, 2e-4, 3e-5, -1e-5},
                         pose,
                         0.1,
                         20.0 / 3});
  set.cameras.push_back({"a \"b\" \xC3\xA4", {8, 6, 8, 8, 4, 3}, {}, 0, 0});
  return set;
}

TEST(CameraSet, IsReadBackToTheBit) {
  const std::string path = fresh_folder("cameras") + "/cameras.json";
  for (const bool z_depth : {false, true}) {
    CameraSet set = two_cameras();
    set.z_depth = z_depth;
    write_cameras(path, set);
    EXPECT_TRUE(is_camera_set(path));
    Diagnostics diagnostics;
    const CameraSet read = read_cameras(path, diagnostics);
    EXPECT_TRUE(diagnostics.all().empty());
    EXPECT_EQ(read.z_depth, z_depth);
    ASSERT_EQ(read.cameras.size(), 2U);
    for (std::size_t i = 0; i < 2; ++i) {
      const PlacedCamera &a = set.cameras[i], &b = read.cameras[i];
      const Camera &c = a.camera, &d = b.camera;
      EXPECT_EQ(a.name, b.name);
      EXPECT_EQ((std::array{c.width_px, c.height_px}), (std::array{d.width_px, d.height_px}));
      EXPECT_EQ((std::array{c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2}),
                (std::array{d.fx, d.fy, d.cx, d.cy, d.k1, d.k2, d.k3, d.k4, d.p1, d.p2}));
      EXPECT_EQ(a.world_from_camera.r, b.world_from_camera.r);
      EXPECT_EQ(a.world_from_camera.t, b.world_from_camera.t);
      EXPECT_EQ((std::array{a.near_m, a.far_m}), (std::array{b.near_m, b.far_m}));
    }
    const std::string first = read_text_file(path);
    write_cameras(path, read);
    EXPECT_EQ(read_text_file(path), first);
  }
}

TEST(CameraSet, RowsOfNumbersAreNone) {
  const std::string path = fresh_folder("rows") + "/path.txt";
  plain_write(path, "# first\n1 0 0 0 0 1 0 0 0 0 1 0\n");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "");
  EXPECT_FALSE(is_camera_set(path));
  plain_write(path, "\r\n\t {}");
  EXPECT_TRUE(is_camera_set(path));
}

TEST(CameraSet, WhatIsNoCameraIsNamedByFileAndNumber) {
  const std::string path = fresh_folder("bad") + "/cameras.json";
  write_cameras(path, two_cameras());
  const std::string good = read_text_file(path);
  const auto error_with = [&](const std::string& old, const std::string& text) {
    std::string changed = good;
    const std::size_t at = changed.rfind(old);
    EXPECT_NE(at, std::string::npos) << old;
    plain_write(path, changed.replace(at, old.size(), text));
    return error_of([&] {
      Diagnostics diagnostics;
      (void)read_cameras(path, diagnostics);
    });
  };
  const std::string whole =
      "; give a cameras.json as `semfield render` writes it, or a text file with a camera-to-world matrix a line";
  EXPECT_EQ(error_with("semfield-cameras-1", "nerfstudio"),
            path + ": its 'format' is not 'semfield-cameras-1'" + whole);
  EXPECT_EQ(error_with("distance along the ray", "metres"),
            path + ": its 'near_far' is neither 'distance along the ray' nor 'z-depth'" + whole);
  EXPECT_EQ(error_with("\"cameras\"", "\"frames\""), path + ": it has no list 'cameras' with a camera in it" + whole);
  EXPECT_EQ(error_with("]\n}\n", "").find(path + ": not valid JSON: parse error at line 8"), 0U);
  EXPECT_EQ(error_with("\"k1\":0.0", "\"k1\":1e999").find(path + ": not valid JSON: "), 0U);
  const std::string second = "the cameras have problems:\n" + path + ": camera 1: ";
  const std::pair<std::string, std::string> cases[][2] = {
      {{"\"fx\":8.0", "\"fx\":-8"}, {"", "focal length"}},
      {{"\"fx\":8.0", "\"fx\":\"8\""}, {"", "'fx' is not a number; write a number"}},
      {{"\"fx\":8.0,", ""}, {"", "'fx' is missing; write a number"}},
      {{"\"k1\":0.0", "\"kl\":0.0"}, {"", "unknown key 'kl'; did you mean 'k1'?"}},
      {{"\"width\":8", "\"width\":8.5"}, {"", "'width' x 'height' is not a pair of whole numbers of pixels"}},
      {{"\"width\":8", "\"width\":1e9"}, {"", "limits.image_axis_px"}},
      {{"[0,0,0,1]", "[0,0,1]"}, {"", "'world_from_camera' is no list of 4 rows of 4 numbers"}},
      {{"[0,0,0,1]", "[0,0,1,1]"}, {"", "the last row of the pose is not 0 0 0 1"}},
      {{"[1.0,0.0,0.0,0.0]", "[2.0,0.0,0.0,0.0]"}, {"", "pose is no rotation"}},
      {{"[1.0,0.0,0.0,0.0]", "[-1.0,0.0,0.0,0.0]"}, {"", "pose mirrors the scene"}},
      {{"\"p2\":0.0", "\"p2\":0.0,\"near\":2,\"far\":2"},
       {"", "'near' and 'far' are no distances with 0 <= near < far"}},
      {{"\"p2\":0.0", "\"p2\":0.0,\"near\":2"}, {"", "'far' is missing"}},
      {{"a \\\"b\\\" \xC3\xA4", ""}, {"", "its name is empty"}},
      {{"a \\\"b\\\" \xC3\xA4", "a\\nb"}, {"", "its name has a control character"}},
      {{"a \\\"b\\\" \xC3\xA4", "rgb_0001"}, {"", "its files would be called 'rgb_0001', as those of 'rgb/0001'"}},
  };
  for (const auto& [change, said] : cases) {
    const std::string error = error_with(change.first, change.second);
    EXPECT_EQ(error.find(second), 0U) << error;
    EXPECT_NE(error.find(said.second), std::string::npos) << error;
  }
}

}  // namespace
}  // namespace semfield
