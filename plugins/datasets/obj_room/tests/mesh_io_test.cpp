// OBJ files as they should be: shapes, names, materials, polygons.
#include "datasets/obj_room/mesh_io.h"

#include <gtest/gtest.h>

#include "datasets/obj_room/tests/obj_testing.h"
#include "formats/image_io.h"

namespace semfield {
namespace {

using namespace testing_obj;

using Corners = std::array<std::uint32_t, 3>;

double area_of(const TriangleMesh& mesh) {
  double area = 0;
  for (const Corners& t : mesh.triangles) {
    const Vec3f a = mesh.positions[t[0]], b = mesh.positions[t[1]], c = mesh.positions[t[2]];
    area += 0.5 * static_cast<double>(length(cross(b - a, c - a)));
  }
  return area;
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
  Diagnostics d;
  const TriangleMesh mesh = load_obj(folder + "/good.obj", d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  ASSERT_EQ(mesh.positions.size(), 4u);
  EXPECT_EQ(mesh.positions[2], (Vec3f{0, 1, 0}));
  ASSERT_EQ(mesh.size(), 3u);
  EXPECT_EQ(mesh.triangles[1], (Corners{0, 1, 3}));
  EXPECT_EQ(mesh.uv[0], (std::array<std::array<float, 2>, 3>{{{0.25f, 0.5f}, {1, 0}, {0, 1}}}));
  EXPECT_EQ(mesh.uv[1], (std::array<std::array<float, 2>, 3>{}));
  EXPECT_EQ(mesh.normals[1][2], (Vec3f{0, 0, 1}));
  EXPECT_EQ(mesh.normals[2][0], (Vec3f{}));
  EXPECT_EQ(mesh.objects, (std::vector<std::string>{"desk top", "lamp"}));
  EXPECT_EQ(mesh.object_of, (std::vector<std::int32_t>{0, 0, 1}));
  ASSERT_EQ(mesh.group_of.size(), 3u);
  const auto group = [&](std::size_t i) { return mesh.groups[static_cast<std::size_t>(mesh.group_of[i])]; };
  EXPECT_EQ(group(0), "left");
  EXPECT_EQ(group(1), "right side");
  EXPECT_EQ(group(2), "");
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
  Diagnostics d;
  const TriangleMesh mesh =
      load_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf -3/-3 -2/-2 -1/-1\nv 9 9 9\nf -4 -3 -1\n", d);
  ASSERT_EQ(mesh.size(), 2u);
  EXPECT_EQ(mesh.triangles[0], (Corners{0, 1, 2}));
  EXPECT_EQ(mesh.triangles[1], (Corners{0, 1, 3}));
  EXPECT_EQ(mesh.uv[0][2], (std::array<float, 2>{0, 1}));
}

TEST(MeshIo, GroupsAreTheObjectsOfAFileWithoutObjects) {
  Diagnostics d;
  const TriangleMesh mesh =
      load_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ng chair_1\nf 1 2 3\ng\nf 1 2 3\ng chair_1\nf 1 2 3\n", d);
  EXPECT_EQ(mesh.objects, (std::vector<std::string>{"unnamed", "chair_1"}));
  EXPECT_EQ(mesh.object_of, (std::vector<std::int32_t>{0, 1, 0, 1}));
}

TEST(MeshIo, BoundsLeaveOutVerticesThatNoFaceUses) {
  Diagnostics d;
  const TriangleMesh mesh = load_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 50 60 70\nf 1 2 3\n", d);
  EXPECT_EQ(mesh.bounds.hi, (Vec3d{1, 1, 0}));
}

TEST(MeshIo, EveryLineEndReadsTheSame) {
  const std::string unix_text = "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
  for (const std::string end : {"\r\n", "\r"}) {
    std::string text;
    for (const char c : unix_text) text += c == '\n' ? end : std::string(1, c);
    Diagnostics d;
    const TriangleMesh mesh = load_text(text, d);
    EXPECT_EQ(mesh.objects, std::vector<std::string>{"a"});
    EXPECT_EQ(mesh.size(), 1u);
  }
}

TEST(MeshIo, ConcavePolygonKeepsItsArea) {
  // An L of area 3 in the plane y = 1, whose fan from the first corner would cover more than the L.
  Diagnostics d;
  const TriangleMesh mesh = load_text("v 1 1 2\nv 1 1 1\nv 2 1 1\nv 2 1 0\nv 0 1 0\nv 0 1 2\nf 1 2 3 4 5 6\n", d);
  ASSERT_EQ(mesh.size(), 4u);
  EXPECT_NEAR(area_of(mesh), 3.0, 1e-6);
  const auto facet = [&](std::size_t i) {
    const Corners& t = mesh.triangles[i];
    const Vec3f a = mesh.positions[t[0]];
    return cross(mesh.positions[t[1]] - a, mesh.positions[t[2]] - a);
  };
  for (std::size_t i = 1; i < 4; ++i) EXPECT_GT(dot(facet(i), facet(0)), 0) << "triangle " << i << " is turned over";
}

TEST(MeshIo, TriangulationOfConcavePolygonsInEveryPlaneAndTurn) {
  // An arrow head of area 2 with its notch at (1, 1).
  const std::array<std::array<float, 2>, 4> arrow{{{0, 0}, {1, 1}, {2, 0}, {1, 3}}};
  for (int plane = 0; plane < 3; ++plane) {
    for (int turn = 0; turn < 8; ++turn) {
      std::vector<Vec3f> corners;
      for (int k = 0; k < 4; ++k) {
        const auto& p = arrow[static_cast<std::size_t>(((turn < 4 ? k : 3 - k) + turn) % 4)];
        Vec3f v{0.5f, 0.5f, 0.5f};
        v[(plane + 1) % 3] = p[0];
        v[(plane + 2) % 3] = p[1];
        corners.push_back(v);
      }
      double area = 0;
      const auto triangles = triangulate_polygon(corners);
      ASSERT_EQ(triangles.size(), 2u);
      for (const auto& t : triangles) {
        const Vec3f a = corners[static_cast<std::size_t>(t[0])], b = corners[static_cast<std::size_t>(t[1])],
                    c = corners[static_cast<std::size_t>(t[2])];
        area += 0.5 * static_cast<double>(length(cross(b - a, c - a)));
      }
      EXPECT_NEAR(area, 2.0, 1e-6) << "plane " << plane << " turn " << turn;
    }
  }
}

TEST(MeshIo, PolygonThatCrossesItselfStillGivesTriangles) {
  const auto triangles = triangulate_polygon({{0, 0, 0}, {1, 1, 0}, {1, 0, 0}, {0, 1, 0}});
  EXPECT_EQ(triangles.size(), 2u);
}

}  // namespace
}  // namespace semfield
