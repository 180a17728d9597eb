// COLMAP models: both kinds of file say the same, extent, damage. Lenses, sizes, labels: tests/bad_files/indexes.cases.
#include <cstring>

#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

template <class... T>
void put(std::string& out, T... values) {
  (out.append(reinterpret_cast<const char*>(&values), sizeof values), ...);
}
using Count = std::uint64_t;
using Id = std::uint32_t;

// Two views of one 8 x 4 camera: view a at the origin, view b turned by 90 degrees about y and moved.
constexpr double kHalf = 0.70710678118654752;
constexpr double kPoses[2][7] = {{1, 0, 0, 0, 0, 0, 0}, {2 * kHalf, 0, 2 * kHalf, 0, 1, 2, 3}};  // b not normalised
constexpr double kOpencv[8] = {6, 5, 4.5, 2.25, 0.01, -0.02, 0.003, -0.004};
constexpr int kPoints = 200;
Vec3d point(int i) { return {0.01 * i - 1, 0.005 * i, 4 + 0.02 * i}; }

struct Binary {
  std::string cameras, images, points;
  Binary() {
    put(cameras, Count{1}, Id{7}, std::int32_t{4}, Count{8}, Count{4});  // an OPENCV camera of 8 x 4 pixels
    for (const double p : kOpencv) put(cameras, p);
    put(images, Count{2});
    for (Id i = 0; i < 2; ++i) {
      put(images, i + 1);
      for (const double v : kPoses[i]) put(images, v);
      put(images, Id{7});
      images += i == 0 ? std::string("a.png") + '\0' : std::string("b.png") + '\0';
      put(images, Count{kPoints + 1});
      for (int p = -1; p < kPoints; ++p) put(images, 1.0, 2.0, std::int64_t{p < 0 ? -1 : 10 + p});
    }
    put(points, Count{kPoints});
    for (int p = 0; p < kPoints; ++p) {
      put(points, 10 + static_cast<Count>(p), point(p).x, point(p).y, point(p).z);
      points += "rgb";
      put(points, 0.5, Count{1}, Id{1}, Id{0});
    }
  }
  void write(const std::string& folder) const {
    plain_write(folder + "/cameras.bin", cameras);
    plain_write(folder + "/images.bin", images);
    plain_write(folder + "/points3D.bin", points);
  }
};

void write_binary(const std::string& folder) { Binary().write(folder); }
void write_text(const std::string& folder) {
  std::string points = "# points\n", seen = "1 2 -1";
  char text[128];
  for (int p = 0; p < kPoints; ++p) {
    std::snprintf(text, sizeof text, "%d %.17g %.17g %.17g 1 2 3 0.5 1 0\n", 10 + p, point(p).x, point(p).y,
                  point(p).z);
    points += text;
    seen += " 1 2 " + std::to_string(10 + p);
  }
  plain_write(folder + "/cameras.txt", "# cameras\n7 OPENCV 8 4 6 5 4.5 2.25 0.01 -0.02 0.003 -0.004\n");
  std::snprintf(text, sizeof text, "2 %.17g 0 %.17g 0 1 2 3 7 b.png\r\n", 2 * kHalf, 2 * kHalf);
  plain_write(folder + "/images.txt", "#\n1 1 0 0 0 0 0 0 7 a.png\n" + seen + "\n" + text + seen + "\n");
  plain_write(folder + "/points3D.txt", points);
}

// root/images/{a,b}.png of 8 x 4 pixels, model in root/sparse/0 by `model`.
std::string scene_folder(const std::string& name, const std::function<void(const std::string&)>& model) {
  const std::string folder = fresh_folder(name);
  std::filesystem::create_directories(folder + "/images");
  std::filesystem::create_directories(folder + "/sparse/0");
  for (const char* image : {"a", "b"})
    write_png_rgb(folder + "/images/" + image + ".png", 8, 4, std::vector<std::uint8_t>(96, 9));
  model(folder + "/sparse/0");
  return folder;
}

SceneInfo open(const std::string& folder, Diagnostics& diagnostics) {
  return NamedDataset("colmap", {{"root", folder}}).open(diagnostics);
}

std::vector<std::string> problems(const Diagnostics& diagnostics) {
  std::vector<std::string> out;
  for (const Diagnostic& d : diagnostics.all()) {
    if (d.severity != Severity::note) out.push_back(d.text());
  }
  return out;
}

TEST(Colmap, TextAndBinaryGiveTheSameScene) {
  Diagnostics d;
  const SceneInfo binary = open(scene_folder("b", write_binary), d);
  const SceneInfo text = open(scene_folder("t", write_text), d);
  EXPECT_EQ(problems(d), std::vector<std::string>{});
  ASSERT_EQ(binary.frames.size(), 2u);
  ASSERT_EQ(text.frames.size(), 2u);
  for (std::size_t i = 0; i < 2; ++i) {
    EXPECT_EQ(binary.frames[i].name, text.frames[i].name);
    EXPECT_EQ(binary.frames[i].world_from_camera.r, text.frames[i].world_from_camera.r);
    EXPECT_EQ(binary.frames[i].world_from_camera.t, text.frames[i].world_from_camera.t);
    EXPECT_EQ(binary.frames[i].camera.fx, 6.0);
    EXPECT_EQ(text.frames[i].camera.fy, 5.0);
    EXPECT_EQ(text.frames[i].camera.cx, 4.5);
    EXPECT_EQ(binary.frames[i].camera.p2, -0.004);
  }
  EXPECT_EQ(binary.bounds.lo, text.bounds.lo);
  EXPECT_EQ(binary.bounds.hi, text.bounds.hi);
  EXPECT_EQ(binary.near_hint_m, text.near_hint_m);
  EXPECT_FALSE(binary.metric);
}

TEST(Colmap, WorldToCameraIsInvertedAndPointsLieInFront) {
  Diagnostics d;
  const SceneInfo info = open(scene_folder("b", write_binary), d);
  const Pose& b = info.frames[1].world_from_camera;
  // Turned by 90 degrees about y: camera from world is x -> -z, z -> x, then moved by (1, 2, 3).
  const Vec3d p{0.3, -0.2, 5};
  const Vec3d q = b.apply_inverse(p);
  EXPECT_NEAR(q.x, p.z + 1, 1e-12);
  EXPECT_NEAR(q.y, p.y + 2, 1e-12);
  EXPECT_NEAR(q.z, -p.x + 3, 1e-12);
  // 99 % of the points, a tenth wider, and both cameras (b's centre is (3, -2, -1)).
  EXPECT_NEAR(info.bounds.hi.x, 3, 1e-12);
  EXPECT_NEAR(info.bounds.lo.y, -2, 1e-12);
  EXPECT_NEAR(info.bounds.lo.z, -1, 1e-12);
  EXPECT_NEAR(info.bounds.hi.z, point(198).z + 0.1 * (point(198).z - point(0).z), 0.05);
  EXPECT_GT(info.near_hint_m, 1.0);
  EXPECT_LT(info.near_hint_m, 2.5);
  EXPECT_GT(info.far_hint_m, 9.0);
  EXPECT_LT(info.far_hint_m, 14.0);
}

TEST(Colmap, AbsurdCountsAndNumbersAreRefused) {
  const std::string folder = scene_folder("a", write_binary);
  const auto with = [](std::string bytes, std::size_t at, auto value) {
    std::memcpy(bytes.data() + at, &value, sizeof value);
    return bytes;
  };
  const Binary whole;
  const auto huge = std::uint64_t{1} << 60;
  for (const auto& [file, bytes, said] :
       {std::tuple{"images.bin", with(whole.images, 0, huge), "room for 134 (offset 0)"},
        {"images.bin", with(whole.images, 8 + 64 + 6, ~std::uint64_t{0}), "image points of image 1 of 2"},
        {"points3D.bin", with(whole.points, 8 + 43, huge), "views of point 1 of 200"},
        {"points3D.bin", with(whole.points, 16, std::nan("")), "point 1 of 200 (offset 8)"},
        {"images.bin", with(whole.images, 8 + 64, '\x96'), "image 1: the name"},
        {"cameras.bin", with(whole.cameras, 16, huge), "camera 7: image size"},
        {"cameras.bin", with(whole.cameras, 32, -1.0), "focal length is -1 x 5"}}) {
    whole.write(folder + "/sparse/0");
    plain_write(folder + "/sparse/0/" + file, bytes);
    Diagnostics d;
    const std::string thrown = error_of([&] { open(folder, d); });
    EXPECT_HAS(thrown + all_said(d), said);
  }
}

}  // namespace
}  // namespace semfield
