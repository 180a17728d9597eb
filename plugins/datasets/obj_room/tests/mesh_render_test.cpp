// Frames of a mesh: depth, class and instance in closed form, cut-outs, textures, threads.
#include "datasets/obj_room/mesh_render.h"

#include <gtest/gtest.h>

#include "compute/parallel.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "formats/image_io.h"
#include "scene/camera_path.h"

namespace semfield {
namespace {

using namespace testing_obj;

RenderSettings quick() {
  RenderSettings s;
  s.occlusion_rays = 2;
  s.shadow_rays = 1;
  s.supersample = 2;
  s.seed = 3;
  s.lights.push_back({{0.5, 0, 2}, 0.1, {2, 2, 2}});
  return s;
}

std::vector<std::int16_t> room_classes(const TriangleMesh& mesh) {
  std::vector<std::int16_t> out;
  for (const std::int32_t object : mesh.object_of) out.push_back(class_of_object(object));
  return out;
}

MeshRenderer room_renderer() {
  TriangleMesh mesh = room_mesh();
  std::vector<std::int16_t> classes = room_classes(mesh);
  Diagnostics d;
  return MeshRenderer(std::move(mesh), std::move(classes), quick(), d);
}

TEST(MeshRender, DepthClassAndInstanceOfEveryPixelAreExact) {
  const MeshRenderer renderer = room_renderer();
  const Camera camera = camera_of(61, 47);
  const Pose pose = look_along({0.1, -1, 1.2}, {-0.1, 1, -0.25}, {0, 0, 1});
  FrameBuffer frame;
  renderer.render(camera, pose, 0, frame);
  ASSERT_EQ(frame.depth_m.size(), 61u * 47);
  ASSERT_EQ(frame.rgb.size(), 61u * 47 * 3);
  int crate = 0;
  for (int y = 0; y < 47; ++y) {
    for (int x = 0; x < 61; ++x) {
      const Vec3d d = camera.direction(x + 0.5, y + 0.5);
      const Truth truth = room_truth(pose.t, pose.rotate(d));
      const auto i = static_cast<std::size_t>(61 * y + x);
      EXPECT_NEAR(frame.depth_m[i], truth.distance * d.z, 1e-5) << x << ' ' << y;
      EXPECT_EQ(frame.instance[i], truth.object + 1) << x << ' ' << y;
      EXPECT_EQ(frame.label[i], class_of_object(truth.object)) << x << ' ' << y;
      crate += truth.object >= 6 ? 1 : 0;
    }
  }
  EXPECT_GT(crate, 50);
  // By hand: the middle of the top row looks up at the far wall, the middle of the bottom row at the floor before it.
  EXPECT_EQ(frame.label[30], 0);
  EXPECT_EQ(frame.instance[30], 4);
  EXPECT_EQ(frame.label[61 * 46 + 30], 1);
  EXPECT_EQ(frame.instance[61 * 46 + 30], 5);
}

TEST(MeshRender, SamePixelsForAnyNumberOfThreadsAndAnotherFrameAnotherNoise) {
  const MeshRenderer renderer = room_renderer();
  const Camera camera = camera_of(48, 36);
  const Pose pose = look_along({0.1, -1, 1.2}, {0.2, 1, -0.3}, {0, 0, 1});
  FrameBuffer one, two, other;
  set_thread_count(1);
  renderer.render(camera, pose, 7, one);
  set_thread_count(2);
  renderer.render(camera, pose, 7, two);
  set_thread_count(0);
  renderer.render(camera, pose, 8, other);
  EXPECT_EQ(one.rgb, two.rgb);
  EXPECT_EQ(one.depth_m, two.depth_m);
  EXPECT_EQ(one.label, two.label);
  EXPECT_EQ(one.instance, two.instance);
  EXPECT_EQ(one.depth_m, other.depth_m);
  EXPECT_NE(one.rgb, other.rgb);
}

TEST(MeshRender, NothingHitIsVoidWithTheBackgroundsColour) {
  Diagnostics d;
  TriangleMesh mesh = load_text("v -1 2 -1\nv 1 2 -1\nv 0 2 1\nf 1 2 3\n", d);
  RenderSettings settings = quick();
  settings.background = {0, 0.5f, 0};
  const MeshRenderer renderer(std::move(mesh), {0}, settings, d);
  FrameBuffer frame;
  renderer.render(camera_of(8, 8), look_along({0, 0, 0}, {0, -1, 0}, {0, 0, 1}), 0, frame);
  // 1 - exp(-0.5), sRGB-coded.
  const auto green = static_cast<int>(std::lround(255 * srgb_of_linear(1 - std::exp(-0.5f))));
  for (std::size_t i = 0; i < 64; ++i) {
    EXPECT_EQ(frame.label[i], kVoid);
    EXPECT_EQ(frame.depth_m[i], 0);
    EXPECT_EQ(frame.instance[i], 0);
    EXPECT_EQ(frame.rgb[3 * i], 0);
    EXPECT_EQ(frame.rgb[3 * i + 1], green);
  }
}

/// A sheet at y = 1 with a texture or a mask, a wall at y = 2 behind it; camera at the origin looks along +y.
struct Sheet {
  std::string folder = fresh_folder("sheet");
  Diagnostics diagnostics;

  FrameBuffer render(const std::string& material) {
    plain_write(folder + "/sheet.mtl", "newmtl Sheet\nKd 1 1 1\n" + material + "newmtl Wall\nKd 0 0 0\nKe 0 0 1\n");
    plain_write(
        folder + "/sheet.obj",
        "mtllib sheet.mtl\nv -1 1 -1\nv 1 1 -1\nv 1 1 1\nv -1 1 1\nv -9 2 -9\nv 9 2 -9\nv 9 2 9\nv -9 2 9\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\no sheet\nusemtl Sheet\nf 1/1 2/2 3/3 4/4\no wall\nusemtl Wall\nf 5 6 7 8\n");
    TriangleMesh mesh = load_obj(folder + "/sheet.obj", diagnostics);
    RenderSettings settings;
    settings.occlusion_rays = 0;
    settings.ambient_above = settings.ambient_below = {1, 1, 1};
    settings.supersample = 1;
    const MeshRenderer renderer(std::move(mesh), {0, 0, 1, 1}, settings, diagnostics);
    FrameBuffer frame;
    renderer.render(camera_of(8, 8), look_along({0, 0, 0}, {0, 1, 0}, {0, 0, 1}), 0, frame);
    return frame;
  }
};

TEST(MeshRender, MaskLetsRaysThroughWhereItIsDark) {
  Sheet sheet;
  // The right half and the upper half of the left half are open.
  write_png_gray8(sheet.folder + "/mask.png", 2, 2, std::vector<std::uint8_t>{0, 0, 255, 0});
  const FrameBuffer frame = sheet.render("map_d mask.png\n");
  EXPECT_TRUE(sheet.diagnostics.all().empty());
  for (std::size_t y = 0; y < 8; ++y) {
    for (std::size_t x = 0; x < 8; ++x) {
      const bool solid = x < 4 && y >= 4;
      EXPECT_EQ(frame.label[8 * y + x], solid ? 0 : 1) << x << ' ' << y;
      EXPECT_EQ(frame.instance[8 * y + x], solid ? 1 : 2);
      EXPECT_NEAR(frame.depth_m[8 * y + x], solid ? 1 : 2, 1e-6);
    }
  }
}

TEST(MeshRender, OpacityBelowOneHalfIsOpen) {
  Sheet sheet;
  EXPECT_EQ(sheet.render("d 0.4\n").label, std::vector<std::int16_t>(64, 1));
  EXPECT_EQ(sheet.render("d 0.6\n").label, std::vector<std::int16_t>(64, 0));
}

TEST(MeshRender, TextureStandsTheRightWayUp) {
  Sheet sheet;
  std::vector<std::uint8_t> rgb;
  for (int y = 0; y < 16; ++y) {
    for (int x = 0; x < 16; ++x) {
      const bool red = x < 8 && y < 8;  // red at the upper left, else green
      rgb.insert(rgb.end(), {red ? std::uint8_t{255} : std::uint8_t{0}, red ? std::uint8_t{0} : std::uint8_t{255}, 0});
    }
  }
  write_png_rgb(sheet.folder + "/color.png", 16, 16, rgb);
  const FrameBuffer frame = sheet.render("map_Kd color.png\n");
  EXPECT_TRUE(sheet.diagnostics.all().empty());
  const auto bright = static_cast<int>(std::lround(255 * srgb_of_linear(1 - std::exp(-1.0f))));
  for (std::size_t y = 1; y < 7; ++y) {
    for (std::size_t x = 1; x < 7; ++x) {
      if (x == 3 || x == 4 || y == 3 || y == 4) continue;  // where texels of both colours mix
      const bool red = x < 4 && y < 4;
      EXPECT_NEAR(frame.rgb[3 * (8 * y + x)], red ? bright : 0, 1) << x << ' ' << y;
      EXPECT_NEAR(frame.rgb[3 * (8 * y + x) + 1], red ? 0 : bright, 1) << x << ' ' << y;
    }
  }
}

TEST(MeshRender, TexturesThatCannotBeReadAreNamed) {
  Sheet sheet;
  plain_write(sheet.folder + "/color.png", "no picture at all");
  const FrameBuffer frame = sheet.render("map_Kd color.png\n");
  ASSERT_EQ(sheet.diagnostics.all().size(), 1u);
  const Diagnostic& d = sheet.diagnostics.all()[0];
  EXPECT_EQ(d.severity, Severity::warning);
  EXPECT_EQ(d.where, sheet.folder + "/color.png");
  EXPECT_EQ(d.message.rfind("texture cannot be read: ", 0), 0u) << d.message;
  EXPECT_EQ(d.remedy, "the plain colour is used");
  EXPECT_EQ(frame.label[27], 0);
  EXPECT_GT(frame.rgb[3 * 27], 150);
}

TEST(MeshRender, LightFallsOnWhatFacesItAndShadowsStayDark) {
  Diagnostics d;
  TriangleMesh mesh = load_text(
      "v -4 -4 0\nv 4 -4 0\nv 4 4 0\nv -4 4 0\nv 0 -4 1\nv 4 -4 1\nv 4 4 1\nv 0 4 1\no floor\nf 1 2 3 4\no shelf\nf 5 "
      "6 7 8\n",
      d);
  RenderSettings settings;
  settings.occlusion_rays = 0;
  settings.ambient_above = settings.ambient_below = {0, 0, 0};
  settings.lights.push_back({{2, 0, 2}, 0.01, {5, 5, 5}});
  settings.supersample = 1;
  const MeshRenderer renderer(std::move(mesh), {0, 0, 1, 1}, settings, d);
  FrameBuffer frame;
  // Between floor and shelf: the floor under the shelf (right) is in shadow, the rest (left) is lit.
  renderer.render(camera_of(16, 16), look_along({0, 0, 0.9}, {0, 0.001, -1}, {0, 0, 1}), 0, frame);
  const std::size_t row = 8 * 16;
  EXPECT_EQ(frame.label[row + 2], 0);
  EXPECT_EQ(frame.label[row + 13], 0);
  EXPECT_EQ(frame.rgb[3 * (row + 13)], 0);
}

}  // namespace
}  // namespace semfield
