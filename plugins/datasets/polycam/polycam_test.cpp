// Raw exports of Polycam: corrected cameras, confidence, depth of another size, and files that do not fit.
#include <algorithm>
#include <nlohmann/json.hpp>

#include "scene/scene.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;
using nlohmann::json;

json camera_json(int i) {
  const Camera c = room_camera();
  const Pose pose = opencv_from_opengl(room_pose(i));  // the turn is its own inverse
  json out{{"fx", c.fx}, {"fy", c.fy}, {"cx", c.cx}, {"cy", c.cy}, {"width", 40}, {"height", 30}, {"blur_score", 80}};
  for (std::size_t r = 0; r < 3; ++r) {
    const std::string row = "t_" + std::to_string(r);
    for (std::size_t k = 0; k < 3; ++k) out[row + std::to_string(k)] = pose.r[r][k];
    out[row + "3"] = pose.t[static_cast<int>(r)];
  }
  return out;
}

// Two keyframes; depth of 20 x 15 pixels whose first column is of low, second of medium confidence.
std::string export_of(const std::string& images = "images", const std::string& cameras = "cameras") {
  const std::string folder = fresh_folder(images);
  for (const std::string& part : {images, cameras, std::string("depth"), std::string("confidence")})
    std::filesystem::create_directories(folder + "/keyframes/" + part);
  std::vector<std::uint8_t> rating(300, 255);
  for (std::size_t p = 0; p < 300; p += 20) rating[p] = 0, rating[p + 1] = 127;
  for (const int i : {0, 1}) {
    const std::string name = std::to_string(100 + i), base = folder + "/keyframes/";
    write_png_rgb(base + images + "/" + name + ".png", 40, 30, render_room(room_camera(), room_pose(i)).rgb);
    write_png_gray16(base + "depth/" + name + ".png", 20, 15, mm_of(render_room(room_camera(20, 15), room_pose(i))));
    write_png_gray8(base + "confidence/" + name + ".png", 20, 15, rating);
    plain_write(base + cameras + "/" + name + ".json", camera_json(i).dump());
  }
  return folder;
}

TEST(Polycam, PosesAreOpenGlAndDepthIsAtTheNearestPixel) {
  const std::string folder = export_of();
  Diagnostics d;
  NamedDataset scene("polycam", {{"root", folder}});
  const SceneInfo info = scene.open(d);
  EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_TRUE(info.metric);
  EXPECT_TRUE(info.tracked);
  for (int axis = 0; axis < 3; ++axis)
    EXPECT_LT(length(info.frames[1].world_from_camera.axis(axis) - room_pose(1).axis(axis)), 1e-12) << axis;
  EXPECT_LT(length(info.frames[1].world_from_camera.t - room_pose(1).t), 1e-12);
  FrameBuffer out;
  scene.read(1, out);
  const FrameBuffer half = render_room(room_camera(20, 15), room_pose(1));
  for (std::size_t p = 0; p < out.depth_m.size(); ++p) {
    const std::size_t from = p / 40 / 2 * 20 + p % 40 / 2;
    if (p % 40 < 2) {
      EXPECT_EQ(out.depth_m[p], 0) << "low confidence";
    } else {
      EXPECT_NEAR(out.depth_m[p], half.depth_m[from], 6e-4) << p;
    }
  }
}

TEST(Polycam, ConfidenceIsAskedForAsTheConfigurationSays) {
  const std::string folder = export_of();
  for (const auto& [least, lost] : {std::pair{"low", 0}, {"medium", 2}, {"high", 4}}) {
    Diagnostics d;
    NamedDataset scene("polycam", {{"root", folder}, {"least_confidence", least}});
    scene.open(d);
    FrameBuffer out;
    scene.read(0, out);
    EXPECT_EQ(std::count(out.depth_m.begin(), out.depth_m.end(), 0.0F), 30 * lost);
  }
}

TEST(Polycam, CorrectedCamerasTakeThePlaceOfTheOthers) {
  const std::string folder = export_of("corrected_images", "corrected_cameras");
  for (const char* name : {"images", "cameras"}) std::filesystem::create_directories(folder + "/keyframes/" + name);
  Diagnostics d;
  EXPECT_EQ(NamedDataset("polycam", {{"root", folder}}).open(d).frames.size(), 2u);
  for (const char* part : {"", "/keyframes"}) {
    const Recognised found("polycam", folder + part);
    EXPECT_EQ(found.what, "a raw export of Polycam");
    EXPECT_EQ(found.root, folder);
  }
}

}  // namespace
}  // namespace semfield
