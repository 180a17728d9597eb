// OBJ files: shapes, names, materials and polygons as they should be, and every mistake with its line.
#include "datasets/obj_room/mesh_io.h"

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
  const auto group = [&](std::size_t i) { return mesh.groups[mesh.group_of[i]]; };
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
        const auto& p = arrow[((turn < 4 ? k : 3 - k) + turn) % 4];
        Vec3f v{0.5f, 0.5f, 0.5f};
        v[(plane + 1) % 3] = p[0];
        v[(plane + 2) % 3] = p[1];
        corners.push_back(v);
      }
      double area = 0;
      const auto triangles = triangulate_polygon(corners);
      ASSERT_EQ(triangles.size(), 2u);
      for (const auto& t : triangles) {
        const Vec3f a = corners[t[0]], b = corners[t[1]], c = corners[t[2]];
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

// OBJ files as they come: every bad one gets its own sentence, none a crash.

const std::string kThree = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

struct BadMesh {
  std::string text;
  std::string message;  ///< after the file's path
};

TEST(MeshIoErrors, EachBadFileNamesItsLineAndCause) {
  const std::string again = "; export the mesh again";
  const std::vector<BadMesh> cases{
      {kThree + "o chair_1\nf 1 2 4\n", ":5: object 'chair_1': face names vertex 4 of 3" + again},
      {kThree + "o chair_1\nf 1 2 3\n\nf 1 2 -4\n", ":7: object 'chair_1': face names vertex -4 of 3" + again},
      {kThree + "f 1 2 4\n", ":4: object 'unnamed': face names vertex 4 of 3" + again},
      {kThree + "f 0 1 2\n", ":4: object 'unnamed': face names vertex 0; indices start at 1" + again},
      {"o a\nf 1 2 3\n" + kThree, ":2: object 'a': face names vertex 1 of 0" + again},
      {kThree + "vt 0 0\no a\nf 1/1 2/2 3/1\n", ":6: object 'a': face names texture coordinate 2 of 1" + again},
      {kThree + "vn 0 0 1\no a\nf 1//1 2//-2 3//1\n", ":6: object 'a': face names normal -2 of 1" + again},
      {kThree + "f 1 2\n", ":4: face has 2 corners, at least 3 are needed" + again},
      {kThree + "f 1 2 99999999999\n", ":4: '99999999999' is not an index" + again},
      {kThree + "f 1 2 4294967299\n", ":4: '4294967299' is not an index" + again},
      {kThree + "f 1 2 3.5\n", ":4: '3.5' is not an index" + again},
      {kThree + "f 1 2 three\n", ":4: 'three' is not an index" + again},
      {kThree + "f 1 2 /3\n", ":4: '/3' is not an index" + again},
      {kThree + "f 1 2 2147483647\n", ":4: object 'unnamed': face names vertex 2147483647 of 3" + again},
      {kThree + "f 1 2 -2147483648\n", ":4: object 'unnamed': face names vertex -2147483648 of 3" + again},
      {"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", ":2: 'nan' is not a finite number" + again},
      {"v 0 0 0\nv 0 -inf 0\nv 0 1 0\nf 1 2 3\n", ":2: '-inf' is not a finite number" + again},
      {"v 0 0 1e39\n", ":1: '1e39' is not a finite number" + again},
      {"v 0 0 1e999\n", ":1: '1e999' is not a finite number" + again},
      {"v 0 zero 0\n", ":1: 'zero' is not a finite number" + again},
      {"o a\rv 0 nan 0\r", ":2: 'nan' is not a finite number" + again},
      {"o a\rv 0 0 0\rv 1 0 0\rf 1 2 3\r", ":4: object 'a': face names vertex 3 of 2" + again},
      {"v 0 0\n", ":1: expected 3 numbers, found 2" + again},
      {kThree + "vn 0 0\n", ":4: expected 3 numbers, found 2" + again},
      {kThree + "vt nan\n", ":4: 'nan' is not a finite number" + again},
      {kThree, ": holds no triangle; check that the file was exported completely"},
      {"", ": holds no triangle; check that the file was exported completely"},
      {"\n\n# only a comment\nf\nf \n", ": holds no triangle; check that the file was exported completely"},
      {kThree + "f 1 1 2\n", ": holds no triangle; check that the file was exported completely"},
  };
  const std::string path = fresh_folder("bad") + "/bad.obj";
  for (const BadMesh& bad : cases) {
    plain_write(path, bad.text);
    Diagnostics d;
    EXPECT_EQ(error_of(ErrorKind::data, [&] { load_obj(path, d); }), path + bad.message) << bad.text;
  }
}

TEST(MeshIoErrors, MissingFileIsNoInput) {
  Diagnostics d;
  const std::string path = fresh_folder("none") + "/none.obj";
  EXPECT_HAS(error_of(ErrorKind::no_input, [&] { load_obj(path, d); }), path);
}

TEST(MeshIoErrors, FacesWithoutAreaAreSkippedAndCounted) {
  Diagnostics d;
  const std::string path = fresh_folder("flat") + "/flat.obj";
  plain_write(path, kThree + "v 2 0 0\nf 1 1 2\nf 1 2 3\nf 1 2 4\nf 1 2 4 3\n");
  const TriangleMesh mesh = load_obj(path, d);
  EXPECT_EQ(mesh.zero_area_skipped, 2);
  EXPECT_EQ(mesh.size(), 3u);
  EXPECT_EQ(texts(d), std::vector<std::string>{"note|" + path + ": skipped 2 faces without area"});
}

TEST(MeshIoErrors, MissingMaterialFileMaterialAndTexturesAreNamed) {
  const std::string folder = fresh_folder("missing");
  plain_write(folder + "/there.mtl", "newmtl Wood\nKd 0.5 0.5 0.5\nmap_Kd oak.png\nmap_d holes.png\n");
  plain_write(folder + "/room.obj",
              "mtllib there.mtl\nmtllib away.mtl\n" + kThree + "usemtl Wood\nf 1 2 3\nusemtl Gold\nf 1 2 3\nf 1 2 3\n");
  Diagnostics d;
  const TriangleMesh mesh = load_obj(folder + "/room.obj", d);
  const std::string plain = "; the plain colour is used; add the file to see it";
  EXPECT_EQ(texts(d),
            (std::vector<std::string>{
                "warning|" + folder + "/there.mtl: Wood: texture '" + folder + "/oak.png' is missing" + plain,
                "warning|" + folder + "/there.mtl: Wood: texture '" + folder + "/holes.png' is missing" + plain,
                "warning|" + folder +
                    "/away.mtl: material file is missing; surfaces get a colour by object; "
                    "put it next to the OBJ file",
                "warning|" + folder +
                    "/room.obj: material 'Gold' is not defined; its surfaces get a colour by "
                    "object; add it to the MTL file"}));
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
  Diagnostics d;
  const TriangleMesh mesh = load_obj(folder + "/room.obj", d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  EXPECT_EQ(mesh.materials.size(), 3u);
  EXPECT_EQ(mesh.material_of, (std::vector<std::int32_t>{1, 2}));
}

TEST(MeshIoErrors, BinaryGarbageIsRefusedNotRead) {
  const std::string path = fresh_folder("garbage") + "/garbage.obj";
  std::uint64_t state = 1;
  int refused = 0;
  for (int round = 0; round < 200; ++round) {
    std::string bytes = round % 2 == 0 ? kThree : "o a\n";
    for (int i = 0; i < 400; ++i) {
      state = state * 6364136223846793005ull + 1442695040888963407ull;
      const auto byte = static_cast<char>(state >> 56);
      // Every other round speaks the format's own letters.
      bytes += round % 4 < 2 ? byte : "vfotng \n\r\t/-0123e.#"[static_cast<unsigned char>(byte) % 20];
    }
    plain_write(path, bytes);
    Diagnostics d;
    try {
      const TriangleMesh mesh = load_obj(path, d);
      for (const auto& t : mesh.triangles) {
        for (const std::uint32_t corner : t) ASSERT_LT(corner, mesh.positions.size());
      }
    } catch (const Error& e) {
      EXPECT_EQ(e.kind(), ErrorKind::data) << e.what();
      EXPECT_EQ(std::string(e.what()).rfind(path + ":", 0), 0u) << e.what();
      ++refused;
    }
  }
  EXPECT_GT(refused, 150);
}

TEST(MeshIoErrors, EveryCutOfAGoodFileIsReadOrRefused) {
  const std::string path = fresh_folder("cut") + "/cut.obj";
  const std::string whole = room_text();
  for (std::size_t size = 0; size < whole.size(); size += 3) {
    plain_write(path, whole.substr(0, size));
    Diagnostics d;
    (void)error_of(ErrorKind::data, [&] { EXPECT_LE(load_obj(path, d).size(), 24u); });
  }
}

}  // namespace
}  // namespace semfield
