// OBJ files as they come: every bad one gets its own sentence, none a crash.
#include <gtest/gtest.h>

#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/tests/obj_testing.h"

namespace semfield {
namespace {

using namespace testing_obj;

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
    try {
      load_obj(path, d);
      ADD_FAILURE() << "was read: " << bad.text;
    } catch (const Error& e) {
      EXPECT_EQ(std::string(e.what()), path + bad.message) << bad.text;
      EXPECT_EQ(e.kind(), ErrorKind::data);
    }
  }
}

TEST(MeshIoErrors, MissingFileIsNoInput) {
  Diagnostics d;
  const std::string path = fresh_folder("none") + "/none.obj";
  try {
    load_obj(path, d);
    FAIL();
  } catch (const Error& e) {
    EXPECT_EQ(e.kind(), ErrorKind::no_input);
    EXPECT_NE(std::string(e.what()).find(path), std::string::npos) << e.what();
  }
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
                    "put it beside the OBJ file",
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
    try {
      EXPECT_LE(load_obj(path, d).size(), 24u);
    } catch (const Error& e) {
      EXPECT_EQ(e.kind(), ErrorKind::data) << e.what();
    }
  }
}

}  // namespace
}  // namespace semfield
