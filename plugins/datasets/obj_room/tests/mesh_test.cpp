// OBJ files: shapes, names, materials and polygons as they should be, and every mistake with its line.

#include <gtest/gtest.h>

#include <algorithm>

#include "datasets/obj_room/obj_room.h"
#include "datasets/obj_room/tests/obj_testing.h"
#include "formats/image_io.h"
#include "scene/camera.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using namespace testing_obj;

using Corners = std::array<std::uint32_t, 3>;

TriangleMesh load_sound(const std::string& path) {
  Diagnostics d;
  TriangleMesh mesh = load_obj(path, d);
  EXPECT_EQ(all_said(d), "");
  return mesh;
}

TEST(MeshIo, ReadsPositionsUvsNormalsObjectsGroupsAndMaterials) {
  const std::string folder = fresh_folder("good");
  plain_write(folder + "/good.mtl",
              "# comment\nnewmtl Oak wood\nKd 0.5 0.25 0.125\nmap_Kd maps\\oak.png\n"
              "newmtl Glass\r\nKd 1 1 1\r\nKe 2 3 4\r\nd 0.25\r\nmap_d mask.png\r\n");
  std::filesystem::create_directories(folder + "/maps");
  write_png_rgb(folder + "/maps/oak.png", 1, 1, std::vector<std::uint8_t>{1, 2, 3});
  write_png_rgb(folder + "/mask.png", 1, 1, std::vector<std::uint8_t>{255, 255, 255});
  plain_write(folder + "/good.obj",
              "mtllib good.mtl\nv 0 0 0\nv 2 0 0\r\nv 0 +1 0\n\tv 0 0 3\nvt 0.25 0.5\nvt 1\nvt 0 1\nvn 0 0 2\n"
              "o desk top\ng left\nusemtl Oak wood\nf 1/1/1 2/2/1 3/3/1\n"
              "g right side\nusemtl Glass\nf 1//1 2//1 4//1\n"
              "o lamp\nf 1 3 4\n");
  const TriangleMesh mesh = load_sound(folder + "/good.obj");
  ASSERT_EQ(mesh.positions.size(), 4u);
  EXPECT_EQ(mesh.positions[2], (Vec3f{0, 1, 0}));
  ASSERT_EQ(mesh.size(), 3u);
  EXPECT_EQ(mesh.triangles[1], (Corners{0, 1, 3}));
  EXPECT_EQ(mesh.uv[0], (std::array<std::array<float, 2>, 3>{{{0.25f, 0.5f}, {1, 0}, {0, 1}}}));
  EXPECT_EQ(mesh.uv[1], (decltype(mesh.uv)::value_type{}));
  EXPECT_EQ(mesh.normals[1][2], (Vec3f{0, 0, 1}));
  EXPECT_EQ(mesh.normals[2][0], (Vec3f{}));
  EXPECT_EQ(mesh.objects, (std::vector<std::string>{"desk top", "lamp"}));
  EXPECT_EQ(mesh.object_of, (std::vector<std::int32_t>{0, 0, 1}));
  std::vector<std::string> groups;
  for (const std::int32_t group : mesh.group_of) groups.push_back(mesh.groups[group]);
  EXPECT_EQ(groups, (std::vector<std::string>{"left", "right side", ""}));
  ASSERT_EQ(mesh.materials.size(), 2u);
  EXPECT_EQ(mesh.material_of, (std::vector<std::int32_t>{0, 1, 1}));
  EXPECT_EQ(mesh.materials[0].name, "Oak wood");
  EXPECT_EQ(mesh.materials[0].diffuse, (std::array<float, 3>{0.5f, 0.25f, 0.125f}));
  EXPECT_EQ(mesh.materials[0].diffuse_map, folder + "/maps/oak.png");
  EXPECT_EQ(mesh.materials[0].opacity_map, "");
  EXPECT_EQ(mesh.materials[1].emission, (std::array<float, 3>{2, 3, 4}));
  EXPECT_EQ(mesh.materials[1].opacity, 0.25f);
  EXPECT_EQ(mesh.materials[1].opacity_map, folder + "/mask.png");
  EXPECT_EQ(mesh.bounds.lo, (Vec3d{0, 0, 0}));
  EXPECT_EQ(mesh.bounds.hi, (Vec3d{2, 1, 3}));
  EXPECT_EQ(mesh.zero_area_skipped, 0);
}

TEST(MeshIo, NegativeIndicesCountBackFromTheLastVertexSoFar) {
  const TriangleMesh mesh = load_text(
      "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf -3/-3 -2/-2 -1/-1\nv 9 9 9\nf -4 -3 -1\nv 50 0 0\n");
  ASSERT_EQ(mesh.size(), 2u);
  EXPECT_EQ(mesh.triangles[0], (Corners{0, 1, 2}));
  EXPECT_EQ(mesh.triangles[1], (Corners{0, 1, 3}));
  EXPECT_EQ(mesh.bounds.hi, (Vec3d{9, 9, 9}));
  EXPECT_EQ(mesh.uv[0][2], (std::array<float, 2>{0, 1}));
}

TEST(MeshIo, GroupsAreTheObjectsOfAFileWithoutObjects) {
  const TriangleMesh mesh =
      load_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ng chair_1\nf 1 2 3\ng\nf 1 2 3\ng chair_1\nf 1 2 3\n");
  EXPECT_EQ(mesh.objects, (std::vector<std::string>{"unnamed", "chair_1"}));
  EXPECT_EQ(mesh.object_of, (std::vector<std::int32_t>{0, 1, 0, 1}));
}

TEST(MeshIo, EveryLineEndReadsTheSame) {
  const std::string unix_text = "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
  for (const std::string end : {"\r\n", "\r"}) {
    std::string text;
    for (const char c : unix_text) text += c == '\n' ? end : std::string(1, c);
    const TriangleMesh mesh = load_text(text);
    EXPECT_EQ(mesh.objects, std::vector<std::string>{"a"});
    EXPECT_EQ(mesh.size(), 1u);
  }
}

TEST(MeshIo, TriangulationOfConcavePolygonsInEveryPlaneAndTurn) {
  // An arrow head of area 2 with its notch at (1, 1).
  const std::array<std::array<float, 2>, 4> arrow{{{0, 0}, {1, 1}, {2, 0}, {1, 3}}};
  for (int plane = 0; plane < 3; ++plane) {
    for (int turn = 0; turn < 8; ++turn) {
      std::vector<Vec3f> corners;
      for (int k = 0; k < 4; ++k) {
        const auto& p = arrow[((turn < 4 ? k : 3 - k) + turn) % 4];
        Vec3f v{0.5f, 0.5f, 0.5f};
        v[(plane + 1) % 3] = p[0];
        v[(plane + 2) % 3] = p[1];
        corners.push_back(v);
      }
      Vec3f facets;  // a triangle that is turned over would take its area away
      const auto triangles = triangulate_polygon(corners);
      ASSERT_EQ(triangles.size(), 2u);
      for (const auto& t : triangles)
        facets = facets + cross(corners[t[1]] - corners[t[0]], corners[t[2]] - corners[t[0]]);
      EXPECT_NEAR(0.5 * static_cast<double>(length(facets)), 2.0, 1e-6) << "plane " << plane << " turn " << turn;
    }
  }
}

TEST(MeshIo, PolygonThatCrossesItselfStillGivesTriangles) {
  const auto triangles = triangulate_polygon({{0, 0, 0}, {1, 1, 0}, {1, 0, 0}, {0, 1, 0}});
  EXPECT_EQ(triangles.size(), 2u);
}

// OBJ files as they come: every bad one gets its own sentence, none a crash.

const std::string kThree = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

TEST(MeshIoErrors, MissingMaterialFileMaterialAndTexturesAreNamed) {
  const std::string folder = fresh_folder("missing");
  plain_write(folder + "/there.mtl", "newmtl Wood\nKd 0.5 0.5 0.5\nmap_Kd oak.png\nmap_d holes.png\n");
  plain_write(folder + "/room.obj",
              "mtllib there.mtl\nmtllib away.mtl\n" + kThree + "usemtl Wood\nf 1 2 3\nusemtl Gold\nf 1 2 3\nf 1 2 3\n");
  Diagnostics d;
  const TriangleMesh mesh = load_obj(folder + "/room.obj", d);
  EXPECT_EQ(d.all().size(), 4u);
  for (const char* what : {"/oak.png'", "/holes.png'", "/away.mtl: ", "material 'Gold'"})
    EXPECT_TRUE(std::any_of(d.all().begin(), d.all().end(), [&](const Diagnostic& one) {
      return one.severity == Severity::warning && one.text().find(what) != std::string::npos;
    })) << what;
  EXPECT_EQ(mesh.material_of, (std::vector<std::int32_t>{0, -1, -1}));
  EXPECT_EQ(mesh.materials[0].diffuse_map, "");
  EXPECT_EQ(mesh.materials[0].opacity_map, "");
}

TEST(MeshIoErrors, SeveralMaterialFilesOnOneLine) {
  const std::string folder = fresh_folder("several");
  plain_write(folder + "/a.mtl", "newmtl A\nKd 1 0 0\n");
  plain_write(folder + "/b c.mtl", "newmtl B\nKd 0 1 0\n");
  plain_write(folder + "/d.mtl", "newmtl D\nKd 0 0 1\n");
  plain_write(folder + "/room.obj",
              "mtllib a.mtl d.mtl\nmtllib b c.mtl\n" + kThree + "usemtl D\nf 1 2 3\nusemtl B\nf 1 2 3\n");
  const TriangleMesh mesh = load_sound(folder + "/room.obj");
  EXPECT_EQ(mesh.materials.size(), 3u);
  EXPECT_EQ(mesh.material_of, (std::vector<std::int32_t>{1, 2}));
}

// Pieces of a mesh by class and touch.

// Squares of 20 cm on the floor, of two triangles each.
TriangleMesh squares(const std::vector<float>& at_x) {
  TriangleMesh mesh;
  for (const float x : at_x) {
    const auto first = static_cast<std::uint32_t>(mesh.positions.size());
    for (const auto& [dx, dy] : {std::pair{0.0F, 0.0F}, {0.2F, 0.0F}, {0.2F, 0.2F}, {0.0F, 0.2F}})
      mesh.positions.push_back({x + dx, dy, 0});
    mesh.triangles.push_back({first, first + 1, first + 2});
    mesh.triangles.push_back({first, first + 2, first + 3});
  }
  return mesh;
}

TEST(MeshPieces, WhatIsOfOneClassAndTouchesIsOne) {
  const TriangleMesh mesh = squares({0, 0.2F, 0.6F, 0.8F});
  EXPECT_EQ(pieces_of(mesh, {1, 1, 1, 1, 1, 1, 2, 2}, 0.03), (std::vector<std::int32_t>{0, 0, 0, 0, 1, 1, 2, 2}));
}

TEST(MeshPieces, PlanesThatMeetInNoCornerTouchToo) {
  TriangleMesh mesh = squares({0, 10});
  for (std::size_t k = 4; k < 8; ++k) mesh.positions[k] = mesh.positions[k - 4] * 0.2F + Vec3f{0.08F, 0.08F, 0.01F};
  EXPECT_EQ(pieces_of(mesh, {1, 1, 1, 1}, 0.03), (std::vector<std::int32_t>{0, 0, 0, 0}));
}

// Frames of a mesh in closed form, cut-outs, textures, threads; and the rays that make them.

RenderSettings quick() {
  RenderSettings s{.occlusion_rays = 2, .shadow_rays = 1, .supersample = 2, .seed = 3};
  s.lights.push_back({{0.5, 0, 2}, 0.1, {2, 2, 2}});
  return s;
}

MeshRenderer room_renderer() {
  const TriangleMesh mesh = room_mesh();
  std::vector<std::int16_t> classes;
  for (const std::int32_t object : mesh.object_of) classes.push_back(class_of_object(object));
  Diagnostics d;
  return MeshRenderer(mesh, std::move(classes), quick(), d);
}

FrameBuffer rendered(const MeshRenderer& renderer, const Camera& camera, const Pose& pose, int number = 0) {
  FrameBuffer frame;
  renderer.render(camera, pose, number, frame);
  return frame;
}

TEST(MeshRender, DepthClassAndInstanceOfEveryPixelAreExact) {
  const MeshRenderer renderer = room_renderer();
  const Camera camera = room_camera(61, 47);
  const Pose pose = look_along({0.1, -1, 1.2}, {-0.1, 1, -0.25}, {0, 0, 1});
  const FrameBuffer frame = rendered(renderer, camera, pose);
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
  const Camera camera = room_camera(48, 36);
  const Pose pose = look_along({0.1, -1, 1.2}, {0.2, 1, -0.3}, {0, 0, 1});
  const auto with_threads = [&](int threads) {
    const ThreadScope scope(threads);
    return rendered(renderer, camera, pose, 7);
  };
  const FrameBuffer one = with_threads(1), two = with_threads(2), other = rendered(renderer, camera, pose, 8);
  expect_same(one, two);
  EXPECT_EQ(one.depth_m, other.depth_m);
  EXPECT_NE(one.rgb, other.rgb);
}

TEST(MeshRender, NothingHitIsVoidWithTheBackgroundsColour) {
  Diagnostics d;
  RenderSettings settings = quick();
  settings.background = {0, 0.5f, 0};
  const MeshRenderer renderer(load_text("v -1 2 -1\nv 1 2 -1\nv 0 2 1\nf 1 2 3\n"), {0}, settings, d);
  const FrameBuffer frame = rendered(renderer, room_camera(8, 8), look_along({0, 0, 0}, {0, -1, 0}, {0, 0, 1}));
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
    return rendered(renderer, room_camera(8, 8), look_along({0, 0, 0}, {0, 1, 0}, {0, 0, 1}));
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
  EXPECT_EQ(sheet.diagnostics.all()[0].severity, Severity::warning);
  EXPECT_HAS(sheet.diagnostics.all()[0].text(), sheet.folder + "/color.png: ", "plain colour");
  EXPECT_EQ(frame.label[27], 0);
  EXPECT_GT(frame.rgb[3 * 27], 150);
}

TEST(MeshRender, LightFallsOnWhatFacesItAndShadowsStayDark) {
  Diagnostics d;
  TriangleMesh mesh = load_text(
      "v -4 -4 0\nv 4 -4 0\nv 4 4 0\nv -4 4 0\nv 0 -4 1\nv 4 -4 1\nv 4 4 1\nv 0 4 1\n"
      "o floor\nf 1 2 3 4\no shelf\nf 5 6 7 8\n");
  RenderSettings settings{.occlusion_rays = 0};
  settings.ambient_above = settings.ambient_below = {0, 0, 0};
  settings.lights.push_back({{2, 0, 2}, 0.01, {5, 5, 5}});
  settings.supersample = 1;
  const MeshRenderer renderer(std::move(mesh), {0, 0, 1, 1}, settings, d);
  // Between floor and shelf: the floor under the shelf (right) is in shadow, the rest (left) is lit.
  const FrameBuffer frame = rendered(renderer, room_camera(16, 16), look_along({0, 0, 0.9}, {0, 0.001, -1}, {0, 0, 1}));
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
}

// From names to classes by rules and prefixes, what is said where they do not fit, and camera paths through a room.

const std::string kClasses =
    "classes:\n"
    "  - {id: 0, name: void, ignore: true}\n"
    "  - {id: 3, name: chair}\n"
    "  - {id: 5, name: window}\n"
    "  - {id: 9, name: dining_table}\n";

ClassRules rules_of(const std::string& text, const std::string& name = "classes.yaml") {
  const std::string path = fresh_folder("rules") + "/" + name;
  plain_write(path, text);
  return load_class_rules(path);
}

struct Part {
  std::string object, group, material;
};

// One triangle a part.
TriangleMesh mesh_of(const std::vector<Part>& parts) {
  TriangleMesh mesh;
  const auto index = [](std::vector<std::string>& names, const std::string& name) {
    const auto it = std::find(names.begin(), names.end(), name);
    if (it != names.end()) return static_cast<std::int32_t>(it - names.begin());
    names.push_back(name);
    return static_cast<std::int32_t>(names.size() - 1);
  };
  std::vector<std::string> materials;
  for (const Part& part : parts) {
    mesh.triangles.push_back({0, 1, 2});
    mesh.object_of.push_back(index(mesh.objects, part.object));
    mesh.group_of.push_back(index(mesh.groups, part.group));
    mesh.material_of.push_back(part.material.empty() ? -1 : index(materials, part.material));
  }
  for (const std::string& name : materials) {
    mesh.materials.emplace_back();
    mesh.materials.back().name = name;
  }
  return mesh;
}

std::vector<std::int16_t> classes(const std::vector<Part>& parts, const ClassRules& rules) {
  Diagnostics d;
  const std::vector<std::int16_t> out = classes_of_mesh(mesh_of(parts), rules, d);
  EXPECT_EQ(all_said(d), "");
  return out;
}

TEST(ClassRules, GlobsMatchWholeNames) {
  const std::string many(60, 'a');
  using Pairs = std::vector<std::pair<std::string, const char*>>;
  for (const auto& [name, glob] : Pairs{{"chair_12", "chair_*"},
                                        {"armchair_1", "*chair*"},
                                        {"a_b_c_b", "a*b"},
                                        {"leg3", "leg?"},
                                        {"", "*"},
                                        {"a*b", "a*b"},
                                        {many, "*a*a*a*a*a*a*a*a"}})
    EXPECT_TRUE(matches_glob(name, glob)) << name << " by " << glob;
  for (const auto& [name, glob] : Pairs{{"armchair_1", "chair_*"},
                                        {"a_b_c", "a*b"},
                                        {"leg", "leg?"},
                                        {"Chair", "chair"},
                                        {many, "*a*a*a*a*a*a*a*a*b"}})
    EXPECT_FALSE(matches_glob(name, glob)) << name << " by " << glob;
}

TEST(ClassRules, RulesByObjectGroupAndMaterialTheEarlierWins) {
  const ClassRules rules = rules_of(kClasses +
                                    "rules:\n"
                                    "  - {object: \"thing_*\", material: Glass, class: window}\n"
                                    "  - {object: \"thing_?\", class: chair}\n"
                                    "  - {group: \"legs*\", class: dining_table}\n"
                                    "  - {material: \"Dust*\", class: void}\n"
                                    "  - {object: \"*\", material: Glass, class: chair}\n");
  EXPECT_EQ(rules.rules.size(), 5u);
  const std::vector<Part> parts{{"thing_1", "", "Glass"},
                                {"thing_1", "", "Wood"},
                                {"Mesh7", "legs_2", "Wood"},
                                {"Mesh7", "", "Dusty"},
                                {"Mesh7", "", "Glass"}};
  EXPECT_EQ(classes(parts, rules), (std::vector<std::int16_t>{1, 0, 2, kVoid, 0}));
}

TEST(ClassRules, ObjectNamesDecideWithoutARule) {
  std::vector<Part> parts;
  for (const char* object : {"chair", "chair__Mesh037_Wood", "chair_12", "window.003", "dining_table_2", "void_1"})
    parts.push_back({object, "", ""});
  EXPECT_EQ(classes(parts, rules_of(kClasses)), (std::vector<std::int16_t>{0, 0, 0, 1, 2, kVoid}));
}

TEST(ClassRules, EveryObjectWithoutAClassIsReportedInOnePass) {
  const TriangleMesh mesh = mesh_of({{"chair_1", "", ""},
                                     {"stool_1", "", ""},
                                     {"stool_1", "seat", "Wood"},
                                     {"Chair_1", "", "Oak"},
                                     {"chairs_1", "row", ""},
                                     {"chair12", "", ""}});
  Diagnostics d;
  const std::vector<std::int16_t> out = classes_of_mesh(mesh, rules_of(kClasses), d);
  EXPECT_EQ(out, (std::vector<std::int16_t>{0, kVoid, kVoid, kVoid, kVoid, kVoid}));
  EXPECT_EQ(d.error_count(), 4);
  for (const char* name : {"stool_1", "Chair_1", "chairs_1", "chair12"})
    EXPECT_HAS(all_said(d), "object '" + std::string(name) + "'",
               "{object: \"" + std::string(name) + "\", class: NAME}");
}

TEST(ClassRules, TablesWithoutRulesReadToo) {
  EXPECT_EQ(rules_of("class_id,class\n0,void\n1,chair\n", "classes.csv").table.valid_count(), 1);
  const ClassRules list = rules_of("- {id: 1, name: chair}\n- {id: 2, name: table}\n");
  EXPECT_EQ(list.table.valid_count(), 2);
  EXPECT_TRUE(list.rules.empty());
}

// What a generated camera path promises.

// A 6 x 5 x 2.75 m room with pillars: free space has corners to cut.
TriangleMesh pillars() {
  std::ostringstream obj;
  int vertices = 0;
  const std::array<const char*, 6> wall{"wall_1", "wall_2", "wall_3", "wall_4", "floor_1", "ceiling_1"};
  const std::array<const char*, 6> pillar{"pillar_1", "pillar_2", "pillar_3", "pillar_4", "pillar_5", "pillar_6"};
  add_box(obj, {{-3, -2.5, 0}, {3, 2.5, 2.75}}, wall, vertices);
  for (const double x : {-1.5, 0.0, 1.5}) {
    for (const double y : {-0.75, 0.75})
      add_box(obj, {{x - 0.125, y - 0.125, 0}, {x + 0.125, y + 0.125, 2.75}}, pillar, vertices);
  }
  return load_text(obj.str());
}

PathSettings settings_of(const TriangleMesh& mesh, int poses, std::uint64_t seed) {
  return PathSettings{.poses = poses, .seed = seed, .region = mesh.bounds};
}

bool same(const Pose& a, const Pose& b) { return a.r == b.r && a.t == b.t; }

TEST(RoomPath, EveryPoseIsFreeLevelAndARotation) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  for (std::uint64_t seed = 0; seed < 6; ++seed) {
    const PathSettings s = settings_of(mesh, 120, seed);
    const std::vector<Pose> path = make_camera_path(rays, s);
    ASSERT_EQ(path.size(), 120u);
    for (std::size_t i = 0; i < path.size(); ++i) {
      const Pose& p = path[i];
      EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m) << "seed " << seed << " pose " << i;
      EXPECT_GE(p.t.z, s.lowest_m - 0.2);
      EXPECT_LE(p.t.z, s.highest_m + 0.2);
      EXPECT_NEAR(p.r[2][0], 0, 1e-12) << "the camera's x axis is not level";
      EXPECT_LT(p.r[2][1], 0) << "the camera's y axis points up";
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) EXPECT_NEAR(dot(p.axis(a), p.axis(b)), a == b ? 1 : 0, 1e-12);
      }
      EXPECT_NEAR(dot(cross(p.axis(0), p.axis(1)), p.axis(2)), 1, 1e-12);
      EXPECT_FALSE(i > 0 && same(p, path[i - 1])) << "seed " << seed << " pose " << i << " repeats the one before";
    }
  }
}

TEST(RoomPath, ClearanceHoldsBesideThinPoles) {
  // Poles thinner than the steps in which a way is tried.
  std::ostringstream obj;
  int vertices = 0;
  const std::array<const char*, 6> names{"a", "b", "c", "d", "e", "f"};
  add_box(obj, {{-1.5, -1.5, 0}, {1.5, 1.5, 2.5}}, names, vertices);
  for (int i = 0; i < 49; ++i) {
    const double x = 0.375 * (i % 7 - 3), y = 0.375 * (i / 7 - 3);
    add_box(obj, {{x, y, 0}, {x + 0.0078125, y + 0.0078125, 2.5}}, names, vertices);
  }
  const TriangleMesh mesh = load_text(obj.str());
  const Raycaster rays(mesh);
  for (std::uint64_t seed = 80; seed < 112; ++seed) {
    PathSettings s = settings_of(mesh, 120, seed);
    s.clearance_m = 0.03;
    for (const Pose& p : make_camera_path(rays, s))
      EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m) << "seed " << seed;
  }
}

TEST(RoomPath, TheWayBetweenPosesDoesNotPassThroughSurfaces) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  const std::vector<Pose> path = make_camera_path(rays, settings_of(mesh, 200, 11));
  int through = 0;
  for (std::size_t i = 1; i < path.size(); ++i) {
    const Vec3d way = path[i].t - path[i - 1].t;
    const double far = length(way);
    if (far > 0 && rays.blocked(path[i - 1].t, way * (1 / far), far)) ++through;
  }
  EXPECT_EQ(through, 0);
}

TEST(RoomPath, UpMayBeY) {
  std::ostringstream obj;
  int vertices = 0;
  add_box(obj, {{-2, 0, -1.5}, {2, 2.5, 1.5}}, {"a", "b", "c", "d", "e", "f"}, vertices);
  const TriangleMesh mesh = load_text(obj.str());
  const Raycaster rays(mesh);
  PathSettings s = settings_of(mesh, 16, 1);
  s.up = {0, 1, 0};
  for (const Pose& p : make_camera_path(rays, s)) {
    EXPECT_NEAR(p.r[1][0], 0, 1e-12);
    EXPECT_LT(p.r[1][1], 0);
    EXPECT_GE(p.t.y, 0.7);
    EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m);
  }
}

}  // namespace
}  // namespace semfield
