// A scene whose cameras were fixed, written and read again.
#include "app/scene/posed_scene.h"
#include "datasets/transforms_json/transforms_json.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

struct Source {
  PosedScene scene;
  FixedCameras fixed;

  Source() {
    SceneInfo& info = scene.info;
    info.name = "source";
    info.classes = ClassTable(std::vector<ClassEntry>{{7, "wall", {1, 2, 3}, false}, {300, "lamp", {4, 5, 6}, false}});
    for (int i = 0; i < 4; ++i) {
      FrameInfo f{.name = "a/" + std::to_string(i),
                  .source = "none",
                  .camera = room_camera(16, 12),
                  .world_from_camera = room_pose(i)};
      f.split = i == 1 ? Split::test : i == 3 ? Split::unused : Split::train;
      f.has_depth = f.has_labels = f.has_instances = true;
      info.frames.push_back(f);
      fixed.cameras.push_back(f.camera);
      fixed.cameras.back().fx *= 1.1;
      fixed.cameras.back().k1 = i == 2 ? 0 : -0.01;
      fixed.poses.push_back(room_pose(i + 1));
    }
    scene.read = [](int frame, FrameBuffer& out) {
      out.width_px = 16;
      out.height_px = 12;
      for (int p = 0; p < 16 * 12; ++p) {
        for (int c = 0; c < 3; ++c) out.rgb.push_back(static_cast<std::uint8_t>(p + c));
        out.depth_m.push_back(p == 5 ? 0.0f : 2.0f + 0.001f * static_cast<float>(p + frame));
        out.label.push_back(p == 7 ? kVoid : static_cast<std::int16_t>(p % 2));
        out.instance.push_back(p);
        out.used.push_back(p == 9 ? 0 : 1);
      }
    };
  }
  void write(const std::string& folder) const {
    app::write_fixed_scene(scene, fixed, folder, [](const CaptureStep&, double, double) {});
  }
};

TEST(FixedScene, HasTheNewCamerasAndEverythingElseAsItWas) {
  const Source source;
  const std::string folder = fresh_folder("fixed");
  source.write(folder);
  TransformsJson again(TransformsJsonParams{.root = folder}, {});
  Diagnostics d;
  const SceneInfo info = again.open(d);
  for (const Diagnostic& one : d.all()) EXPECT_EQ(one.severity, Severity::note) << one.text();
  ASSERT_EQ(info.frames.size(), 3u) << "the unused one is in neither list";
  EXPECT_EQ(info.frames[0].name, "0");
  EXPECT_TRUE(info.frames[1].split == Split::test && info.frames[2].split == Split::train);
  for (std::size_t i = 0; i < 3; ++i) {
    const Camera &found = info.frames[i].camera, &wanted = source.fixed.cameras[i];
    EXPECT_TRUE(found == wanted) << i << ": " << found.fx << " " << found.k1;
    EXPECT_LT(length(info.frames[i].world_from_camera.t - source.fixed.poses[i].t), 1e-12);
    EXPECT_LT(length(info.frames[i].world_from_camera.axis(2) - source.fixed.poses[i].axis(2)), 1e-12);
    FrameBuffer was, is;
    source.scene.read(static_cast<int>(i), was);
    again.read(static_cast<int>(i), is);
    EXPECT_EQ(is.rgb, was.rgb);
    EXPECT_EQ(is.label, was.label);
    EXPECT_EQ(is.instance, was.instance);
    EXPECT_EQ(is.used, was.used);
    ASSERT_EQ(is.depth_m.size(), was.depth_m.size());
    for (std::size_t p = 0; p < was.depth_m.size(); ++p) EXPECT_NEAR(is.depth_m[p], was.depth_m[p], 6e-5) << p;
  }
}

// One camera that took all depth stands in the file; of several, depth is drawn into the colour images.
TEST(FixedScene, DepthOfACameraOfItsOwn) {
  Source source;
  source.fixed.depth_apart = true;
  source.fixed.depth_from_color.t = {0, 0, 0.5};
  source.fixed.depth_cameras.assign(4, source.scene.info.frames[0].camera);
  const auto middle = [](const std::string& folder) {
    TransformsJson again(TransformsJsonParams{.root = folder}, {});
    Diagnostics d;
    (void)again.open(d);
    FrameBuffer out;
    again.read(0, out);
    return out.depth_m[6 * 16 + 8];
  };
  const std::string one = fresh_folder("one"), several = fresh_folder("several");
  source.write(one);
  EXPECT_HAS(read_text_file(one + "/transforms.json"), "\"depth_camera\"");
  EXPECT_NEAR(middle(one), 1.6f, 0.02f);
  source.fixed.depth_cameras[3].fx += 1;
  source.write(several);
  EXPECT_EQ(read_text_file(several + "/transforms.json").find("depth_camera"), std::string::npos);
  EXPECT_NEAR(middle(several), 1.6f, 0.02f);
}

}  // namespace
}  // namespace semfield
