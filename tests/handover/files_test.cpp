// Files for other programs: read by a script of the standard library, and by programs that nobody here wrote.
#include "system/files.h"

#include <sys/wait.h>

#include <cstdlib>
#include <nlohmann/json.hpp>

#include "core/text.h"
#include "handover/point_files.h"
#include "handover/splats.h"
#include "handover/voxel_map.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

// Ids over 255, a name of two words, and void with an id of its own.
ClassTable classes() {
  return ClassTable({{7, "void", {0, 0, 0}, true},
                     {3, "wall", {200, 100, 50}, false},
                     {30, "dining table", {10, 20, 30}, false},
                     {300, "lamp", {255, 255, 255}, false}});
}

constexpr int kIds[] = {3, 30, 300, 7};

// A strip of triangles far from 0, where 32 bits are too few.
Surface strip() {
  Surface s;
  for (int i = 0; i < 12; ++i) {
    s.positions.push_back({500'000.25 + 0.11 * i, 4'000'000.5 + (i % 2), -1.5 + 0.07 * i});
    s.normals.push_back(normalized(Vec3d{0.1 * i, -0.3, i < 6 ? 1.0 : -1.0}));
    s.attributes.color.push_back({static_cast<std::uint8_t>(20 * i), 100, static_cast<std::uint8_t>(255 - i)});
    s.attributes.label.push_back(static_cast<std::int16_t>(i % 4 == 3 ? kVoid : i % 4));
    s.attributes.entropy.push_back(0.125F * static_cast<float>(i));
    s.attributes.instance.push_back(i < 5 ? 0 : i < 9 ? 2 : 70'000);
    if (i >= 2)
      s.triangles.push_back(
          {static_cast<std::uint32_t>(i - 2), static_cast<std::uint32_t>(i - 1), static_cast<std::uint32_t>(i)});
  }
  return s;
}

PointSet points() {
  const Surface s = strip();
  return {s.positions, s.normals, std::vector<float>(s.positions.size(), 0.02F), s.attributes};
}

// A camera in the middle of a box of two metres sees its walls at z = 1.
VoxelMap small_map() {
  VoxelMap map(VoxelGridPlace::covering({{-0.45, -0.35, -0.2}, {0.6, 0.4, 1.05}}, 0.1));
  RayCamera camera;
  camera.camera = {8, 6, 10, 10, 4, 3};
  RenderedFrame frame;
  frame.width_px = 8;
  frame.height_px = 6;
  frame.opacity.assign(48, 1);
  frame.depth_m.assign(48, 1);
  frame.label.resize(48);
  for (std::size_t i = 0; i < 48; ++i) frame.label[i] = static_cast<std::int16_t>(i % 8 < 4 ? 0 : 2);
  map.add(camera, frame, seen_pixels(camera, frame));
  return map;
}

nlohmann::json cells_of(const VoxelMap& map) {
  nlohmann::json out{{"count", map.place().count}, {"first", map.place().first}, {"edge", map.place().edge}};
  for (std::int64_t x = 0; x < map.place().count[0]; ++x)
    for (std::int64_t y = 0; y < map.place().count[1]; ++y)
      for (std::int64_t z = 0; z < map.place().count[2]; ++z) {
        const std::size_t cell = map.place().index(x, y, z);
        const VoxelState state = map.state(cell);
        out["occupancy"].push_back(state == VoxelState::occupied ? 100 : state == VoxelState::free ? 0 : -1);
        out["class_id"].push_back(map.label(cell) == kVoid ? -1 : classes().id_of(map.label(cell)));
      }
  return out;
}

nlohmann::json rows_of(const std::vector<Vec3d>& vectors) {
  nlohmann::json out;
  for (const Vec3d& v : vectors) out.push_back({v.x, v.y, v.z});
  return out;
}

class HandOverFiles : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    dir_ = new TempDir;
    const PointSet set = points();
    const Vec3d offset = offset_of_floats(box_around(set.positions));
    EXPECT_EQ(offset, (Vec3d{500'000, 4'000'000 + 0.0, 0}));
    nlohmann::json want{{"positions", rows_of(set.positions)},
                        {"normals", rows_of(set.normals)},
                        {"colors", set.attributes.color},
                        {"instances", set.attributes.instance},
                        {"offset", {offset.x, offset.y, offset.z}}};
    for (const std::int16_t label : set.attributes.label) want["ids"].push_back(kIds[label == kVoid ? 3 : label]);
    const VoxelMap map = small_map();
    want["cells"] = cells_of(map);
    write_ply(*dir_ / "points.ply", set, classes());
    write_ply(*dir_ / "mesh.ply", strip(), classes());
    write_glb(*dir_ / "mesh.glb", strip(), classes(), {{0, 0, 1}, true, {{2, "chair 2"}}});
    write_pcd(*dir_ / "points.pcd", set, classes(), offset);
    write_las(*dir_ / "points.las", set, classes());
    Splats splats{set, {}, 0.02};
    for (std::size_t i = 0; i < set.positions.size(); ++i) splats.opacity.push_back(0.08F * static_cast<float>(i + 1));
    want["opacity"] = splats.opacity;
    write_file_atomic(*dir_ / "expected.json", want.dump());
    write_splat_ply(*dir_ / "points.splats.ply", splats, classes(), offset);
    write_splat(*dir_ / "points.splat", splats, offset);
    write_voxels(*dir_ / "map.npz", map, classes());
    EXPECT_EQ(write_octomap(*dir_ / "map.bt", map, classes(), false), Vec3d{});
    write_octomap(*dir_ / "map.ot", map, classes(), true);
  }
  static void TearDownTestSuite() {
    delete dir_;
    dir_ = nullptr;
  }
  // 77: the program is not here.
  static int read_by(const std::string& program) {
    const std::string command = "python3 " + shell_word(SEMFIELD_SOURCE_DIR "/tests/handover/check_files.py") + " " +
                                shell_word(dir_->path()) + " " + program;
    return WEXITSTATUS(std::system(command.c_str()));
  }
  static TempDir* dir_;
};
TempDir* HandOverFiles::dir_ = nullptr;

TEST_F(HandOverFiles, HoldWhatWasMeant) {
  if (std::system("python3 -c 'import json, struct' >/dev/null 2>&1") != 0) GTEST_SKIP() << "no python3 here";
  EXPECT_EQ(read_by("own"), 0);
}

class ReadBy : public HandOverFiles, public ::testing::WithParamInterface<const char*> {};

TEST_P(ReadBy, AProgramThatNobodyHereWrote) {
  const int code = read_by(GetParam());
  if (code == 77) GTEST_SKIP() << GetParam() << " is not here: its files were written and not read by it";
  EXPECT_EQ(code, 0);
}
INSTANTIATE_TEST_SUITE_P(Programs, ReadBy,
                         ::testing::Values("cloudcompare", "meshlab", "open3d", "pcl", "las", "octomap", "gltf"),
                         [](const auto& of) { return std::string(of.param); });

TEST_F(HandOverFiles, AGlbFarFromZeroIsMovedBackByItsRoot) {
  const std::string bytes = read_text_file(*dir_ / "mesh.glb");
  const auto root = nlohmann::json::parse(bytes.substr(20, bytes.find("BIN", 20) - 4 - 20));
  EXPECT_EQ(root["asset"]["extras"]["offset"], (nlohmann::json{500'000.0, 4'000'000.0, 0.0}));
  // +z becomes +y, so y becomes -z.
  const auto back = root["nodes"][0]["translation"].get<std::vector<double>>();
  EXPECT_NEAR(back[0], 500'000, 1e-6);
  EXPECT_NEAR(back[1], 0, 1e-6);
  EXPECT_NEAR(back[2], -4'000'000, 1e-6);
}

TEST(Splats, TheirOpacityMakesTheMediumsOpticalDepth) {
  // Light through many layers of a grid, at places between its points: the mean of the logarithm is the depth.
  for (const double depth : {0.05, 0.5, 1.5}) {
    const double a = splat_opacity(depth, kSplatWidth);
    double sum = 0;
    constexpr int kPlaces = 40;
    for (int i = 0; i < kPlaces; ++i)
      for (int j = 0; j < kPlaces; ++j)
        for (int x = -4; x <= 4; ++x)
          for (int y = -4; y <= 4; ++y) {
            const double u = x + (i + 0.5) / kPlaces, v = y + (j + 0.5) / kPlaces;
            sum -= std::log(1 - a * std::exp(-(u * u + v * v) / (2 * kSplatWidth * kSplatWidth)));
          }
    EXPECT_NEAR(sum / (kPlaces * kPlaces), depth, 0.005 * depth) << depth;
  }
  EXPECT_EQ(splat_opacity(0, kSplatWidth), 0);
  EXPECT_EQ(splat_opacity(99, kSplatWidth), kMostOpacity);
}

TEST(Sidecar, TellsWorldClassesAndFiles) {
  const ClassTable table = classes();
  const Sidecar sidecar{
      "runs/a", "room",           40,
      false,    Vec3d{0, 0, 1},   {true, false, 0.001, 1},
      &table,   {{2, "chair 2"}}, {{"out/a.pcd", "points", {100, 0, 0}}, {"out/a.bt", "voxels", {}, 0.05}}};
  const auto json = nlohmann::json::parse(sidecar_json(sidecar));
  EXPECT_EQ(json["format"], "semfield-handover-1");
  EXPECT_EQ(json["world"]["unit"], "scene");
  EXPECT_EQ(json["world"]["pose_scale"], 0.001);
  EXPECT_EQ(json["world"]["camera_axes_flipped"], true);
  EXPECT_EQ(json["files"][0]["file"], "a.pcd");
  EXPECT_EQ(json["files"][0]["offset"][0], 100);
  EXPECT_FALSE(json["files"][0].contains("edge"));
  EXPECT_EQ(json["files"][1]["edge"], 0.05);
  EXPECT_EQ(json["classes"][0]["id"], 3);
  EXPECT_EQ(json["objects"], (nlohmann::json{{{"id", 2}, {"name", "chair 2"}}}));
}

}  // namespace
}  // namespace semfield
