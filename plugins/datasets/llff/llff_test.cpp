// poses_bounds.npy: axes, order of images, sizes, and files that do not fit.
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

// Down is +y, right +x and backward -z of the world: the identity in OpenCV axes.
std::vector<float> row(float x, float height = 4, float width = 8, float focal = 6) {
  return {0, 1, 0, x, height, 1, 0, 0, 2, width, 0, 0, -1, 3, focal, 0.5f, 8};
}

std::string scene(const std::vector<std::vector<float>>& rows, int images = 2) {
  const std::string folder = fresh_folder(std::to_string(rows.size()) + "_" + std::to_string(images));
  std::filesystem::create_directories(folder + "/images");
  for (int i = 0; i < images; ++i)
    write_png_rgb(folder + "/images/" + std::to_string(i) + ".png", 4, 2, std::vector<std::uint8_t>(24, 9));
  std::vector<float> all;
  for (const auto& r : rows) all.insert(all.end(), r.begin(), r.end());
  const std::int64_t shape[] = {static_cast<std::int64_t>(rows.size()), static_cast<std::int64_t>(rows[0].size())};
  write_npy(folder + "/poses_bounds.npy", shape, all);
  return folder;
}

SceneInfo open(const std::string& folder, Diagnostics& d) {
  return NamedDataset("llff", {{"root", folder}, {"test_every", "0"}}).open(d);
}

TEST(Llff, AxesAndSizes) {
  Diagnostics d;
  const SceneInfo info = open(scene({row(1), row(-1)}), d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[0].world_from_camera.axis(0), (Vec3d{1, 0, 0}));
  EXPECT_EQ(info.frames[0].world_from_camera.axis(1), (Vec3d{0, 1, 0}));
  EXPECT_EQ(info.frames[0].world_from_camera.axis(2), (Vec3d{0, 0, 1}));
  EXPECT_EQ(info.frames[1].world_from_camera.t, (Vec3d{-1, 2, 3}));
  EXPECT_EQ(info.frames[0].camera.fx, 3.0) << "the poses are of images twice as large";
  EXPECT_EQ(info.frames[0].camera.cx, 2.0);
  EXPECT_FALSE(info.metric) << "nothing tells the unit";
  EXPECT_EQ(info.far_hint_m, 0.0) << "what the file says of distances is often made up";
  EXPECT_HAS(d.all().at(0).text(), "images are 4 x 2 pixels, the cameras' 8 x 4, 2 times as large");
}

TEST(Llff, FilesThatDoNotFitAreRefused) {
  Diagnostics d;
  EXPECT_HAS(error_of([&] { open(scene({row(1), row(2), row(3)}), d); }), "has 3 frames, ");
  std::vector<float> short_row = row(1);
  short_row.pop_back();
  EXPECT_HAS(error_of([&] { open(scene({short_row, short_row}), d); }), "shape (2, 16) is not that of poses");
  EXPECT_HAS(error_of([&] { open(fresh_folder("none"), d); }), "poses_bounds.npy");
  for (const auto& [bad, said] : {std::pair{row(1, 0, 0), "no image size in its row 0"},
                                  {row(1, 4.5, 8), "no image size in its row 0"},
                                  {row(1, 4, 8, -2), "focal length is"}}) {
    Diagnostics found;
    open(scene({bad, row(2)}), found);
    EXPECT_HAS(all_said(found), said);
  }
  std::vector<float> no_centre = row(1);
  no_centre[3] = std::numeric_limits<float>::quiet_NaN();
  const std::vector<float> nothing(no_centre.size(), no_centre[3]);  // as writers of a lost frame leave the row
  for (const std::vector<float>& lost : {no_centre, nothing}) {
    Diagnostics pose;
    EXPECT_EQ(open(scene({lost, row(2)}), pose).frames.size(), 1u);
    EXPECT_FALSE(pose.has_errors());
    EXPECT_FINDING(pose, "scene.pose.skipped", "poses_bounds.npy", "1 of 2");
  }
}

}  // namespace
}  // namespace semfield
