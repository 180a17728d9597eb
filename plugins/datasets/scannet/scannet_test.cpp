// Exported ScanNet scenes, whose depth and labels have sizes of their own. Tables, frames and trouble:
// tests/bad_files/indexes.cases.
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kTable =
    "id\traw_category\tnyu40id\teigen13id\tnyu40class\teigen13class\n"
    "101\twest wall\t1\t12\twall\tWall\n102\teast wall\t1\t12\twall\tWall\n103\tceiling\t22\t3\tceiling\tCeiling\n"
    "104\tcarpet\t2\t5\tfloor\tFloor\n105\tsouth\t38\t7\totherstructure\tObjects\n106\tdoor\t8\t\tdoor\t\n";

// Depth is cropped as well as smaller, so that only intrinsics, not ratios of sizes, can find its pixels.
Camera depth_camera() {
  Camera c = room_camera(20, 16);
  c.fx = c.fy = 12;
  c.cx = 9.5;
  c.cy = 8.25;
  return c;
}
constexpr int kLabelWidth = 60, kLabelHeight = 45;

std::string matrix(const Camera& c) {
  return std::to_string(c.fx) + " 0 " + std::to_string(c.cx - 0.5) + " 0\n0 " + std::to_string(c.fy) + " " +
         std::to_string(c.cy - 0.5) + " 0\n0 0 1 0\n0 0 0 1\n";
}

// Colour 40 x 30, frame numbers 0, 10, 20, ...; raw id = 101 + wall.
std::string write_scannet(const std::string& name, int frames) {
  const std::string folder = fresh_folder(name) + "/scene0000_00";
  for (const char* part : {"color", "depth", "pose", "intrinsic", "label-filt", "instance-filt"})
    std::filesystem::create_directories(folder + "/" + part);
  for (int i = 0; i < frames; ++i) {
    const std::string n = std::to_string(10 * i);
    const Pose pose = room_pose(i);
    write_png_rgb(folder + "/color/" + n + ".png", 40, 30, render_room(room_camera(), pose).rgb);
    write_png_gray16(folder + "/depth/" + n + ".png", 20, 16, mm_of(render_room(depth_camera(), pose)));
    const FrameBuffer large = render_room(room_camera(kLabelWidth, kLabelHeight), pose);
    std::vector<std::uint16_t> raw;
    for (const std::int16_t wall : large.label) raw.push_back(static_cast<std::uint16_t>(101 + wall));
    raw[0] = 0;
    write_png_gray16(folder + "/label-filt/" + n + ".png", kLabelWidth, kLabelHeight, raw);
    write_png_gray8(folder + "/instance-filt/" + n + ".png", kLabelWidth, kLabelHeight, ids_of(large));
    plain_write(folder + "/pose/" + n + ".txt", pose_line(pose));
  }
  plain_write(folder + "/intrinsic/intrinsic_color.txt", matrix(room_camera()));
  plain_write(folder + "/intrinsic/intrinsic_depth.txt", matrix(depth_camera()));
  plain_write(folder + "/../scannetv2-labels.combined.tsv", kTable);
  return folder;
}

TEST(Scannet, ColourCameraDeliversDepthAndLabelsOfOtherSizes) {
  NamedDataset scene("scannet", {{"root", write_scannet("s", 4)}});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  for (const Diagnostic& x : d.all()) EXPECT_EQ(x.severity, Severity::note) << x.text();
  ASSERT_EQ(info.frames.size(), 4u);
  EXPECT_EQ(info.frames[1].name, "10");
  EXPECT_EQ(info.frames[0].split, Split::train);
  EXPECT_EQ(info.frames[1].split, Split::test);
  EXPECT_EQ(info.frames[0].camera.width_px, 40);
  EXPECT_NEAR(info.frames[0].camera.cx, 20, 1e-9);  // 19.5 with whole-number centres
  ASSERT_EQ(info.classes.valid_count(), 5);         // 1, 2, 8, 22, 38
  EXPECT_EQ(info.classes.valid(0).name, "wall");
  EXPECT_EQ(info.classes.valid(4).id, 38);
  const int index_of_wall[] = {0, 0, 3, 1, 4, 2};
  for (int i = 0; i < 4; ++i) {
    const FrameBuffer got = scene.read(i);
    const FrameBuffer want = render_room(room_camera(), room_pose(i));
    EXPECT_EQ(got.rgb, want.rgb);
    int seen = 0, same_label = 0, same_instance = 0;
    for (int y = 0; y < 30; ++y) {
      for (int x = 0; x < 40; ++x) {
        const auto p = static_cast<std::size_t>(40 * y + x);
        same_label += got.label[p] == index_of_wall[want.label[p]] ? 1 : 0;
        same_instance += got.instance[p] == want.instance[p] ? 1 : 0;
        // The depth pixel that holds the point where the colour pixel's ray meets the depth image.
        const double u = 12 * (x + 0.5 - 20) / 20 + 9.5, v = 12 * (y + 0.5 - 15) / 20 + 8.25;
        if (u < 0 || u >= 20 || v < 0 || v >= 16) {
          ASSERT_EQ(got.depth_m[p], 0.0f);
          continue;
        }
        ++seen;
        const Vec3d ray = depth_camera().direction(std::floor(u) + 0.5, std::floor(v) + 0.5);
        const double z = trace(room_pose(i).t, room_pose(i).rotate(ray)).t * ray.z;
        ASSERT_NEAR(got.depth_m[p], z, 0.000501) << i << ": " << x << ", " << y;
      }
    }
    EXPECT_GT(seen, 800);
    EXPECT_LT(seen, 1200);
    EXPECT_GE(same_label, 1200 - 60);  // nearest pixels differ along the edges of walls, and one pixel is void
    EXPECT_GE(same_instance, 1200 - 60);
    EXPECT_EQ(got.label[0], kVoid);
  }
}

}  // namespace
}  // namespace semfield
