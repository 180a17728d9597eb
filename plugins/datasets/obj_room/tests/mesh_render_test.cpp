// Frames of a mesh in closed form, cut-outs, textures, threads; and the rays that make them.
#include "datasets/obj_room/mesh_render.h"

#include <algorithm>

#include "compute/parallel.h"
#include "datasets/obj_room/raycast.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "formats/image_io.h"
#include "scene/camera_path.h"

namespace semfield {
namespace {

using namespace testing_obj;

RenderSettings quick() {
  RenderSettings s{.occlusion_rays = 2, .shadow_rays = 1, .supersample = 2, .seed = 3};
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
    RenderSettings settings{.occlusion_rays = 0};
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
  RenderSettings settings{.occlusion_rays = 0};
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

// Rays and distances against a room in closed form.

std::vector<Vec3d> directions(int count) {
  std::vector<Vec3d> out;
  for (int i = 0; i < count; ++i) {
    const double z = 1 - (2 * i + 1.0) / count, r = std::sqrt(1 - z * z), phi = 2.399963229728653 * i;
    out.push_back({r * std::cos(phi), r * std::sin(phi), z});
  }
  return out;
}

TEST(Raycast, EveryDirectionMeetsTheRightObjectAtTheRightDistance) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  int crate = 0;
  for (const Vec3d origin : {Vec3d{0.1, -1, 1.2}, Vec3d{-1.7, 1.3, 2.3}}) {
    for (const Vec3d d : directions(4000)) {
      const RayHit hit = rays.trace(origin, d);
      const Truth truth = room_truth(origin, d);
      ASSERT_TRUE(hit.hit());
      EXPECT_NEAR(hit.distance_m, truth.distance, 1e-6 * (1 + truth.distance));
      EXPECT_EQ(mesh.object_of[hit.triangle], truth.object) << d.x << ' ' << d.y << ' ' << d.z;
      crate += truth.object >= 6 ? 1 : 0;
      // The barycentric weights lead to the same point.
      const auto& t = mesh.triangles[hit.triangle];
      const Vec3f p =
          mesh.positions[t[0]] * (1 - hit.b1 - hit.b2) + mesh.positions[t[1]] * hit.b1 + mesh.positions[t[2]] * hit.b2;
      const Vec3d q = origin + d * truth.distance;
      EXPECT_NEAR(length(Vec3d{p.x, p.y, p.z} - q), 0, 2e-5);
    }
  }
  EXPECT_GT(crate, 50);
}

TEST(Raycast, ReachesEndWhereAsked) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const Vec3d origin{0, -1, 1.5}, ahead{0, 1, 0};
  EXPECT_FALSE(rays.trace(origin, ahead, 2.4).hit());
  EXPECT_TRUE(rays.trace(origin, ahead, 2.6).hit());
  EXPECT_FALSE(rays.blocked(origin, ahead, 2.4));
  EXPECT_TRUE(rays.blocked(origin, ahead, 2.6));
  EXPECT_FALSE(rays.trace({0, 0, 10}, {0, 0, 1}).hit());
  EXPECT_FALSE(rays.blocked({0, 0, 10}, {0, 0, 1}, 1e6));
}

TEST(Raycast, ClearanceIsTheDistanceToTheNearestSurface) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const auto outside = [](double x, double lo, double hi) { return std::max({lo - x, 0.0, x - hi}); };
  int near_crate = 0;
  for (const Vec3d d : directions(500)) {
    const Vec3d p{1.9 * d.x, 1.4 * d.y, 1.25 + 1.2 * d.z};
    double expected = 1e300;
    for (int a = 0; a < 3; ++a) expected = std::min({expected, p[a] - kRoom.lo[a], kRoom.hi[a] - p[a]});
    const double crate = length(Vec3d{outside(p.x, kCrate.lo.x, kCrate.hi.x), outside(p.y, kCrate.lo.y, kCrate.hi.y),
                                      outside(p.z, kCrate.lo.z, kCrate.hi.z)});
    if (crate == 0) continue;  // within the crate
    near_crate += crate < expected ? 1 : 0;
    expected = std::min(expected, crate);
    EXPECT_NEAR(rays.clearance(p, 100), expected, 1e-9);
    EXPECT_EQ(rays.clearance(p, 0.5 * expected), 0.5 * expected);
  }
  EXPECT_GT(near_crate, 10);
}

TEST(Raycast, CutOutsLetRaysThroughWhereTheTestSaysSo) {
  const TriangleMesh mesh = room_mesh();
  std::vector<bool> cut_out(mesh.size());
  for (std::size_t i = 0; i < mesh.size(); ++i) cut_out[i] = mesh.object_of[i] >= 6;
  const Vec3d origin{0, -1, 0.5}, ahead{0, 1, 0};
  const auto object_ahead = [&](const Raycaster& rays) { return mesh.object_of[rays.trace(origin, ahead).triangle]; };
  const Raycaster open(mesh, cut_out, [](std::int64_t, float, float) { return false; });
  const Raycaster shut(mesh, cut_out, [](std::int64_t, float, float) { return true; });
  EXPECT_EQ(object_ahead(open), 3);
  EXPECT_FALSE(open.blocked(origin, ahead, 2));
  EXPECT_EQ(object_ahead(shut), 8);
  EXPECT_TRUE(shut.blocked(origin, ahead, 2));
  // Only the front of the crate is open: its back stops the ray, and the test is asked about crate triangles alone.
  const Raycaster front(mesh, cut_out, [&](std::int64_t t, float, float) {
    EXPECT_GE(mesh.object_of[t], 6);
    return mesh.object_of[t] != 8;
  });
  EXPECT_EQ(object_ahead(front), 9);
}

TEST(Raycast, SameHitsFromAnyThread) {
  const TriangleMesh mesh = room_mesh();
  const Raycaster rays(mesh);
  const std::vector<Vec3d> d = directions(3000);
  const auto all = [&](int threads) {
    set_thread_count(threads);
    std::vector<std::pair<std::int64_t, double>> out(d.size());
    parallel_for(static_cast<std::int64_t>(d.size()), [&](std::int64_t i) {
      const RayHit hit = rays.trace({0.3, -0.4, 1.1}, d[i]);
      out[i] = {hit.triangle, hit.distance_m};
    });
    set_thread_count(0);
    return out;
  };
  EXPECT_EQ(all(1), all(2));
}

}  // namespace
}  // namespace semfield
