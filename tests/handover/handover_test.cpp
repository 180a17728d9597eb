// Files for other programs: read by a script of the standard library, and by programs that nobody here wrote.

#include <sys/wait.h>

#include <cstdlib>
#include <cstring>
#include <nlohmann/json.hpp>
#include <sstream>

#include "core/small_math.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "scene/loading/frame_source.h"
#include "scene/loading/packed_scene.h"
#include "surface/fuse/fusion.h"
#include "surface/mesh/point_files.h"
#include "surface/mesh/score/mesh_score.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/sights.h"
#include "surface/mesh/voxel_map.h"
#include "surface/objects/object_set.h"
#include "tests/analytic_scene.h"
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

struct HandOverFiles : ::testing::Test {
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
    write_file_atomic(*dir_ / "expected.json", want.dump());
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
                         ::testing::Values("blender", "cloudcompare", "meshlab", "open3d", "pcl", "las", "octomap",
                                           "gltf"),
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

// Voxels that rays free and fill, and maps of what stands above a floor.

// A camera of one pixel at `from` that sees a surface at `to`.
void see(VoxelMap& map, Vec3d from, Vec3d to, std::int16_t label) {
  RayCamera camera;
  camera.world_from_camera.t = from;
  RenderedFrame frame;
  frame.width_px = frame.height_px = 1;
  frame.opacity = {1};
  frame.depth_m = {1};
  frame.label = {label};
  map.add(camera, frame, {{1}, {to}, {{0, 0, 1}}, {0.1F}});
}

VoxelMap map_of(const Box& box, double edge = 0.1) { return VoxelMap(VoxelGridPlace::covering(box, edge)); }

VoxelState at(const VoxelMap& map, Vec3d place) { return map.state(map.cell_of(place).value()); }

TEST(VoxelMap, ARayFreesWhatItCrossesAndFillsItsEnd) {
  VoxelMap map = map_of({{0, 0, 0}, {1, 1, 1}});
  see(map, {0.05, 0.05, 0.05}, {0.95, 0.55, 0.25}, 2);
  EXPECT_EQ(at(map, {0.05, 0.05, 0.05}), VoxelState::free);
  EXPECT_EQ(at(map, {0.455, 0.275, 0.14}), VoxelState::free);
  EXPECT_EQ(at(map, {0.95, 0.55, 0.25}), VoxelState::occupied);
  EXPECT_EQ(at(map, {0.05, 0.95, 0.05}), VoxelState::unknown);
  EXPECT_EQ(map.label(*map.cell_of({0.95, 0.55, 0.25})), 2);
  EXPECT_EQ(map.label(*map.cell_of({0.05, 0.05, 0.05})), kVoid);
  // No corner of the way is left out: from one cube to the next there is a step along one axis.
  int crossed = 0;
  for (std::size_t cell = 0; cell < map.place().cells(); ++cell) crossed += map.state(cell) == VoxelState::free;
  EXPECT_EQ(crossed, 9 + 5 + 2);
}

TEST(VoxelMap, ManyViewsOutvoteOne) {
  VoxelMap map = map_of({{0, 0, 0}, {1, 0.1, 0.1}});
  const Vec3d eye{0.05, 0.05, 0.05}, near{0.45, 0.05, 0.05}, far{0.95, 0.05, 0.05};
  see(map, eye, near, 0);
  EXPECT_EQ(at(map, near), VoxelState::occupied);
  for (int view = 0; view < 3; ++view) see(map, eye, far, view == 1 ? 4 : 1);
  EXPECT_EQ(at(map, near), VoxelState::free) << "0.85 - 3 x 0.4 is below 0";
  EXPECT_FLOAT_EQ(map.log_odds(*map.cell_of(far)), 3 * 0.85F);
  EXPECT_EQ(map.label(*map.cell_of(far)), 1);
  for (int view = 0; view < 9; ++view) see(map, eye, far, 1);
  EXPECT_FLOAT_EQ(map.log_odds(*map.cell_of(far)), 3.5F);
  EXPECT_FLOAT_EQ(map.log_odds(*map.cell_of(near)), -2.0F);
}

TEST(VoxelMap, ARayFromOutsideIsCutToTheGrid) {
  VoxelMap map = map_of({{0, 0, 0}, {0.39, 0.39, 0.39}});
  see(map, {-1, 0.25, 0.25}, {2, 0.25, 0.25}, 0);
  for (const double x : {0.05, 0.15, 0.25, 0.35}) EXPECT_EQ(at(map, {x, 0.25, 0.25}), VoxelState::free) << x;
  EXPECT_EQ(at(map, {0.05, 0.05, 0.05}), VoxelState::unknown);
  EXPECT_ERROR(map_of({{0, 0, 0}, {1, 1, 1}}, 1e-5), "handover.voxels.many", "choose a larger --voxel");
  EXPECT_ERROR(map_of({{0, 0, 0}, {400, 400, 400}}, 0.1), "handover.voxels.many");
}

// A floor of ten by six cubes, a low thing, a high one, and one cube of the floor that nobody saw above.
VoxelMap furnished(int up_axis, bool negative, double unit = 1) {
  const auto turned = [&](Vec3d p) {  // z of the room along the axis that is up
    if (negative) p.z = -p.z;
    Vec3d out;
    out[up_axis] = p.z;
    out[(up_axis + 1) % 3] = p.x;
    out[(up_axis + 2) % 3] = p.y;
    return out * unit;
  };
  Box box;
  box.include(turned({0, 0, 0}));
  box.include(turned({0.99, 0.59, 0.99}));
  VoxelMap map = map_of(box, 0.1 * unit);
  for (int y = 0; y < 6; ++y)
    for (int x = 0; x < 10; ++x) {
      const double u = 0.1 * x + 0.05, v = 0.1 * y + 0.05;
      const bool hidden = x == 9 && y == 5;
      see(map, turned({u, v, hidden ? 0.05 : 0.95}), turned({u, v, 0.05}), 0);
    }
  for (int k = 0; k < 9; ++k) see(map, turned({0.25, 0.15, 0.95}), turned({0.25, 0.15, 0.35}), 1);
  for (int k = 0; k < 9; ++k) see(map, turned({0.65, 0.35, 0.95}), turned({0.65, 0.35, 0.85}), 2);
  return map;
}

std::string drawn(const Costmap& map) {
  std::string out;
  for (std::int64_t row = 0; row < map.height; ++row) {
    for (std::int64_t column = 0; column < map.width; ++column) {
      const VoxelState state = map.cells[static_cast<std::size_t>(row * map.width + column)];
      out += state == VoxelState::occupied ? '#' : state == VoxelState::free ? '.' : '?';
    }
    out += '\n';
  }
  return out;
}

TEST(Costmap, ABandAboveTheFloorIsSeenFromAbove) {
  const VoxelMap map = furnished(2, false);
  const Costmap low = costmap_of(map, {0, 0, 1}, {0.1, 0.5});
  EXPECT_EQ(drawn(low),
            ".........?\n"
            "..........\n"
            "..........\n"
            "..........\n"
            "..#.......\n"
            "..........\n");
  EXPECT_NEAR(low.floor, 0.1, 1e-12);
  const Costmap high = costmap_of(map, {0, 0, 1}, {0.6, 0.8});
  EXPECT_EQ(drawn(high),
            ".........?\n"
            "..........\n"
            "......#...\n"
            "..........\n"
            "..........\n"
            "..........\n");
}

// The low thing ends 0.3 above the floor: a band reaches into it by a share of a cube, and another begins there.
TEST(Costmap, ABandIsTheSameInEveryUnit) {
  for (const double unit : {1e-4, 1.0, 1e6}) {
    const VoxelMap map = furnished(2, false, unit);
    const auto low_thing = [&](double from) {
      return drawn(costmap_of(map, {0, 0, 1}, {from * unit, 0.5 * unit})).find('#') != std::string::npos;
    };
    EXPECT_TRUE(low_thing(0.299995)) << unit;
    EXPECT_FALSE(low_thing(0.3)) << unit;
  }
}

TEST(Costmap, TheImageIsNoMirrorWhateverIsUp) {
  for (int axis = 0; axis < 3; ++axis) {
    Vec3d up;
    up[axis] = 1;
    const Costmap map = costmap_of(furnished(axis, false), up, {0.1, 0.5});
    EXPECT_EQ(map.along, (std::array<int, 2>{(axis + 1) % 3, (axis + 2) % 3}));
    EXPECT_EQ(drawn(map), drawn(costmap_of(furnished(2, false), {0, 0, 1}, {0.1, 0.5}))) << axis;
    up[axis] = -1;
    const Costmap turned = costmap_of(furnished(axis, true), up, {0.1, 0.5});
    EXPECT_EQ(turned.along, (std::array<int, 2>{(axis + 2) % 3, (axis + 1) % 3}));
    EXPECT_EQ(std::pair(turned.width, turned.height), std::pair(std::int64_t{6}, std::int64_t{10}));
    EXPECT_EQ(turned.cells[static_cast<std::size_t>((9 - 2) * 6 + 1)], VoxelState::occupied) << axis;
  }
}

TEST(Costmap, WritesWhatAMapServerReads) {
  const TempDir dir;
  const Costmap map = costmap_of(furnished(2, false), {0, 0, 1}, {0.1, 0.5});
  EXPECT_EQ(write_costmap(dir / "room.pgm", map), dir / "room.yaml");
  const std::string image = read_text_file(dir / "room.pgm"), yaml = read_text_file(dir / "room.yaml");
  ASSERT_EQ(image.rfind("P5\n10 6\n255\n", 0), 0U);
  const std::string pixels = image.substr(12);
  ASSERT_EQ(pixels.size(), 60U);
  EXPECT_EQ(static_cast<unsigned char>(pixels[42]), 0);
  EXPECT_EQ(static_cast<unsigned char>(pixels[0]), 254);
  EXPECT_EQ(static_cast<unsigned char>(pixels[9]), 205);
  EXPECT_HAS(yaml, "image: room.pgm\n", "\nnegate: 0\n", "\noccupied_thresh: 0.65\nfree_thresh: 0.196\n", ", 0.0]\n");
}

TEST(Costmap, WhatHasNoFloorIsNamed) {
  EXPECT_ERROR(costmap_of(furnished(2, false), normalized(Vec3d{0, 1, 1}), {}), "handover.costmap.up", "--up");
  EXPECT_ERROR(costmap_of(map_of({{0, 0, 0}, {1, 1, 1}}), {0, 0, 1}, {}), "handover.costmap.empty");
}

// One scene in several units: what is found in it, and what files hold of it, is the same but for the unit.

constexpr double kUnits[] = {1e-4, 1e6};
constexpr double kFloat = 1e-6;  // relative, of numbers of 32 bits and what is added to them

// The analytic room, `unit` times as large, whose unit nobody knows.
struct Room {
  double unit;
  LoadedScene scene;
  std::vector<DepthView> views;
  RayLimits limits;

  explicit Room(double unit_of, bool metric = false) : unit(unit_of) {
    Diagnostics diagnostics;
    scene = load_scene(*testkit::make_analytic_scene({.frames = 16}), {}, diagnostics);
    scene.info.metric = metric;
    scene.near_m *= unit;
    scene.far_m *= unit;
    scene.pixel_footprint_m *= unit;
    scene.bounds = {scene.bounds.lo * unit, scene.bounds.hi * unit};
    for (FrameInfo& frame : scene.info.frames) frame.world_from_camera.t = frame.world_from_camera.t * unit;
    for (StoredFrame& frame : scene.frames) {
      std::vector<float> depth = frame.depth_m.expand();
      for (float& z : depth) z = static_cast<float>(z * unit);
      frame.depth_m = DepthMap(std::move(depth));
    }
    limits.near_m = scene.near_m;
    limits.far_m = scene.far_m;
    for (const int f : scene.frames_of(Split::train)) {
      const auto n = static_cast<std::size_t>(f);
      views.push_back(measured_view({scene.info.frames[n].camera, scene.info.frames[n].world_from_camera, false},
                                    scene.frames[n].depth_m));
    }
  }
  Vec3d size() const { return scene.bounds.size(); }
  double longest() const { return std::max({size().x, size().y, size().z}); }
  Surface surface() const { return fused_surface(views, limits, VoxelGrid::covering(scene.bounds, longest() / 40.3)); }
  PointSet points() const {
    PointSet out;
    for (const DepthView& view : views)
      for (std::int64_t i = 0; i < std::ssize(view.map.distance_m); i += 7) {
        const PixelPlace at = strided_place(i, view.map.width_px, view.map.stride);
        out.positions.push_back(point_at(view.camera, {}, at, view.map.distance_m[static_cast<std::size_t>(i)]));
        out.attributes.color.push_back({1, 2, 3});
      }
    return out;
  }
};

const Room& metres() {
  static const Room room(1);
  return room;
}

// The same places, but for the unit.
void expect_same(const std::vector<Vec3d>& found, double unit, const std::vector<Vec3d>& meant, double off) {
  ASSERT_EQ(found.size(), meant.size()) << unit;
  ASSERT_FALSE(found.empty());
  for (std::size_t i = 0; i < found.size(); ++i)
    for (int axis = 0; axis < 3; ++axis) ASSERT_NEAR(found[i][axis] / unit, meant[i][axis], off) << unit << " " << i;
}

TEST(Units, ASurfaceAndItsFilters) {
  Surface meant = metres().surface();
  const Surface whole = meant;
  ASSERT_GT(meant.triangles.size(), 1000U);
  const auto filtered = [](Surface& surface, double unit) {
    const std::size_t holes = close_holes(surface, 2 * unit);
    simplify(surface, surface.triangles.size() / 2);
    return holes;
  };
  const std::size_t holes = filtered(meant, 1);
  for (const double unit : kUnits) {
    const Room room(unit);
    Surface surface = room.surface();
    EXPECT_EQ(surface.triangles, whole.triangles) << unit;
    expect_same(surface.positions, unit, whole.positions, 1e-4);
    std::vector<RayCamera> cameras;
    for (const DepthView& view : room.views) cameras.push_back(view.camera);
    std::size_t seen = 0, wanted = 0;
    const double cell = 1 / 40.3;
    for (const Sights& one : sights_of(surface, cameras, room.limits, cell * room.longest())) seen += one.any();
    cameras.clear();
    for (const DepthView& view : metres().views) cameras.push_back(view.camera);
    for (const Sights& one : sights_of(whole, cameras, metres().limits, cell * metres().longest())) wanted += one.any();
    EXPECT_NEAR(static_cast<double>(seen), static_cast<double>(wanted), 0.002 * static_cast<double>(wanted)) << unit;
    EXPECT_EQ(filtered(surface, unit), holes) << unit;
    EXPECT_EQ(surface.triangles.size(), meant.triangles.size()) << unit;
  }
}

TEST(Units, AMeshIsJudgedWithinTheSameSharesOfAScene) {
  const auto judged = [](const Room& room) {
    const DepthReference reference(room.views, {}, usual_metre(room.scene.info.metric, room.size()));
    return std::pair(reference.points(), reference.score(room.surface()));
  };
  const auto meant = judged(metres());
  EXPECT_GT(meant.second.complete[2], 0.5);
  EXPECT_LT(meant.second.complete[0], meant.second.complete[2]);
  for (const double unit : kUnits) {
    const auto found = judged(Room(unit));
    EXPECT_NEAR(static_cast<double>(found.first), static_cast<double>(meant.first), 0.01 * meant.first) << unit;
    for (std::size_t k = 0; k < 3; ++k) {
      EXPECT_NEAR(found.second.complete[k], meant.second.complete[k], 0.005) << unit;
      EXPECT_NEAR(found.second.accurate[k], meant.second.accurate[k], 0.005) << unit;
    }
  }
}

TEST(Units, AMetreIsOneInARoomAndAShareElsewhere) {
  EXPECT_EQ(usual_metre(true, {4, 3, 2}), 1);
  EXPECT_EQ(usual_metre(true, {40, 3, 2}), 1);
  EXPECT_EQ(usual_metre(true, {0.6, 0.3, 0.3}), 1) << "a shelf";
  EXPECT_EQ(usual_metre(false, {4, 3, 2}), 0.8);
  EXPECT_EQ(usual_metre(true, {4000, 3000, 2000}), 800) << "millimetres that are told as metres";
  EXPECT_EQ(usual_metre(true, {}), 1);
}

template <class T>
T number_at(const std::string& bytes, std::size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

std::vector<Vec3d> in_las(const std::string& file) {
  std::vector<Vec3d> out;
  const auto at = number_at<std::uint32_t>(file, 96);
  const auto bytes = number_at<std::uint16_t>(file, 105);
  for (std::size_t row = at; row < file.size(); row += bytes) {
    Vec3d p;
    for (int k = 0; k < 3; ++k) {
      const auto n = static_cast<std::size_t>(k);
      p[k] = number_at<std::int32_t>(file, row + 4 * n) * number_at<double>(file, 131 + 8 * n) +
             number_at<double>(file, 155 + 8 * n);
    }
    out.push_back(p);
  }
  return out;
}

// Rows of `bytes` behind a header, which begin with three numbers of kind T.
template <class T>
std::vector<Vec3d> in_rows(const std::string& file, const std::string& end, std::size_t bytes, Vec3d offset) {
  std::vector<Vec3d> out;
  for (std::size_t row = file.find(end) + end.size(); row + bytes <= file.size(); row += bytes)
    out.push_back(offset + Vec3d{static_cast<double>(number_at<T>(file, row)),
                                 static_cast<double>(number_at<T>(file, row + sizeof(T))),
                                 static_cast<double>(number_at<T>(file, row + 2 * sizeof(T)))});
  return out;
}

// At its place, and a million sides away from 0, where 32 bits know no place.
TEST(Units, FilesGiveThePointsBack) {
  const TempDir dir;
  const PointSet meant = metres().points();
  for (const double unit : kUnits)
    for (const double away : {0.0, 4012345.0}) {  // no multiple of what offsets are rounded to
      PointSet points = Room(unit).points();
      for (Vec3d& p : points.positions) p = p + Vec3d{away * unit, 0, 0};
      std::vector<Vec3d> places = meant.positions;
      for (Vec3d& p : places) p = p + Vec3d{away, 0, 0};
      const Vec3d offset = offset_of_floats(box_around(points.positions));
      const double off = away > 0 ? 1e-3 : 4 * kFloat;  // doubles so far from 0 are added, and residual offsets
      EXPECT_EQ(length(offset) > 0, away > 0) << unit;
      EXPECT_NEAR(offset.x / unit, away, 1000) << "what is left is small";
      write_las(dir / "a.las", points, {});
      expect_same(in_las(read_text_file(dir / "a.las")), unit, places, off);
      write_pcd(dir / "a.pcd", points, {}, offset);
      expect_same(in_rows<float>(read_text_file(dir / "a.pcd"), "DATA binary\n", 16, offset), unit, places, off);
      write_ply(dir / "a.ply", points, {});
      expect_same(in_rows<double>(read_text_file(dir / "a.ply"), "end_header\n", 27, {}), unit, places, off);
    }
}

TEST(Units, FilesGiveTheMeshBack) {
  const TempDir dir;
  for (const double unit : kUnits) {
    Surface surface = Room(unit).surface();
    surface.attributes.color.assign(surface.positions.size(), {9, 9, 9});
    const std::vector<Vec3d> meant = metres().surface().positions;
    write_obj(dir / "a.obj", surface, {});
    std::istringstream lines(read_text_file(dir / "a.obj"));
    std::vector<Vec3d> places;
    for (std::string line; std::getline(lines, line);) {
      Vec3d p;
      if (std::sscanf(line.c_str(), "v %lf %lf %lf", &p.x, &p.y, &p.z) == 3) places.push_back(p);
    }
    expect_same(places, unit, meant, 1e-4);
  }
}

// The room's depth, rendered.
RenderedFrame rendered(const Room& room, std::size_t view) {
  RenderedFrame frame;
  const auto n = static_cast<std::size_t>(room.scene.frames_of(Split::train)[view]);
  frame.width_px = room.views[view].map.width_px;
  frame.height_px = room.views[view].map.height_px;
  frame.depth_m = room.scene.frames[n].depth_m.expand();
  frame.opacity.assign(frame.depth_m.size(), 1);
  frame.rgb.assign(3 * frame.depth_m.size(), 0.5F);
  frame.label = room.scene.frames[n].label.expand();
  frame.entropy.assign(frame.depth_m.size(), 0);
  return frame;
}

TEST(Units, MapsOfRobotsAndThinnedPoints) {
  const TempDir dir;
  const auto made = [&](const Room& room) {
    const double edge = room.longest() / 30.7, metre = usual_metre(false, room.size());
    VoxelMap map(VoxelGridPlace::covering(
        {room.scene.bounds.lo - Vec3d{edge, edge, edge}, room.scene.bounds.hi + Vec3d{edge, edge, edge}}, edge));
    PointCloud cloud(edge);
    for (std::size_t v = 0; v < room.views.size(); ++v) {
      const RenderedFrame frame = rendered(room, v);
      const SeenPixels seen = seen_pixels(room.views[v].camera, frame);
      map.add(room.views[v].camera, frame, seen);
      cloud.add(frame, seen);
    }
    std::array<std::size_t, 3> states{};
    for (std::size_t cell = 0; cell < map.place().cells(); ++cell) ++states[static_cast<std::size_t>(map.state(cell))];
    write_octomap(dir / "a.bt", map, room.scene.info.classes, false);
    const std::string tree = read_text_file(dir / "a.bt");
    const Costmap costs = costmap_of(map, {0, 0, 1}, {0.1 * metre, metre});
    return std::tuple(states, map.place().count, cloud.points().positions.size(), tree.substr(tree.find("data\n")),
                      costs.cells);
  };
  const auto meant = made(metres());
  EXPECT_GT(std::get<0>(meant)[2], 500U);
  for (const double unit : kUnits) {
    const auto found = made(Room(unit));
    EXPECT_EQ(std::get<0>(found), std::get<0>(meant)) << unit;
    EXPECT_EQ(std::get<1>(found), std::get<1>(meant)) << unit;
    EXPECT_EQ(std::get<2>(found), std::get<2>(meant)) << unit;
    EXPECT_EQ(std::get<3>(found), std::get<3>(meant)) << unit;
    EXPECT_EQ(std::get<4>(found), std::get<4>(meant)) << unit;
  }
}

TEST(Units, LabelsSpreadAndFuse) {
  const auto worth = [](const Room& room) {
    TrainingLabels labels;
    labels.frames.resize(room.scene.frames.size());
    labels.class_pixels.resize(room.scene.frames.size());
    const FrameMaps maps = true_depth(room.scene);
    for (const int f : maps.frames) {
      const auto n = static_cast<std::size_t>(f);
      std::vector<std::int16_t> given = room.scene.frames[n].label.expand();
      for (std::size_t p = 0; p < given.size(); ++p)
        if (p % 17 != 0) given[p] = kVoid;
      labels.class_pixels[n] = {1, 1, 1, 1, 1, 0};
      labels.frames[n].hard = LabelMap(std::move(given));
    }
    std::vector<double> out;
    for (const PropagationMethod method : {PropagationMethod::surface, PropagationMethod::vote}) {
      const TrainingLabels spread = propagate_labels(room.scene, labels, maps, {.method = method}, {});
      for (const int f : maps.frames) {
        std::int64_t labelled = 0;
        for (std::size_t p = 0; p < spread.frames[static_cast<std::size_t>(f)].size(); ++p)
          labelled += spread.frames[static_cast<std::size_t>(f)][p] != kVoid;
        out.push_back(static_cast<double>(labelled));
      }
      for (const auto& [name, value] : spread.steps.back().facts)
        if (name.find("pixels by") == 0 || name == "cells" || name == "connected parts")
          out.push_back(std::stod(value));
    }
    const SceneFusion fused = fuse_scene(room.scene, labels, maps, settled({}, room.scene), {});
    for (const FusionScore& score : fused.scores) {
      out.push_back(1000 * score.confusion.total_accuracy().value());
      out.push_back(1000 * score.views_mean.value());
    }
    return out;
  };
  const std::vector<double> meant = worth(metres());
  for (const double unit : kUnits) {
    const std::vector<double> found = worth(Room(unit));
    ASSERT_EQ(found.size(), meant.size());
    for (std::size_t i = 0; i < found.size(); ++i)
      EXPECT_NEAR(found[i], meant[i], 2 + 0.005 * meant[i]) << unit << " " << i;
  }
  EXPECT_EQ(settled({}, Room(1, true).scene).tolerance, 0.01) << "a centimetre in metres";
  EXPECT_EQ(settled({.tolerance = 0.3}, metres().scene).tolerance, 0.3);
}

TEST(Units, CellsOfASurfaceAndObjects) {
  const auto pooled = [](const Room& room, double away) {
    std::vector<PoolView> views;
    for (std::size_t v = 0; v < room.views.size(); ++v) {
      const int f = room.scene.frames_of(Split::train)[v];
      views.push_back({f, room.views[v].camera, &room.scene.frames[static_cast<std::size_t>(f)], room.views[v].map});
      views.back().camera.world_from_camera.t.x += away * room.unit;
    }
    const SurfacePool pool = make_surface_pool(views, room.limits, 2000);
    std::vector<ObjectRow> rows(1);
    std::vector<Vec3d> position;
    for (const PoolPoint& point : pool.points) position.push_back(point.position);
    const std::vector<std::int32_t> id(position.size(), 1);
    measure_objects(rows, position, id, pool.cell_m(), std::nullopt);
    return std::pair(static_cast<double>(rows[0].points), rows[0].area / room.unit / room.unit);
  };
  const auto meant = pooled(metres(), 0);
  EXPECT_GT(meant.first, 1000);
  for (const double unit : kUnits) {
    EXPECT_NEAR(pooled(Room(unit), 0).first, meant.first, 0.01 * meant.first) << unit;
    EXPECT_NEAR(pooled(Room(unit), 0).second, meant.second, 0.01 * meant.second) << unit;
  }
  EXPECT_NEAR(pooled(metres(), 5e5).first, meant.first, 0.08 * meant.first) << "far from 0, on another grid";
}

TEST(Units, DepthPictures) {
  const TempDir dir;
  for (const double unit : {1e-4, 1.0, 30.0, 1e6}) {
    const Room room(unit);
    const double step = depth_step(false, room.size());
    const std::vector<float> depth = rendered(room, 0).depth_m;
    EXPECT_EQ(write_depth(dir / "d.png", {48, 36}, depth, step), 0) << unit;
    const auto steps = read_ids(dir / "d.png").pixels;
    for (std::size_t i = 0; i < depth.size(); ++i)
      ASSERT_NEAR(steps[i] * step / unit, static_cast<double>(depth[i]) / unit, 0.00201) << unit;
    EXPECT_NEAR(step / unit, unit == 30 ? 1e-3 / 3 : 1e-3, 1e-12);
  }
  EXPECT_EQ(depth_step(true, {40, 3, 3}), 1e-3) << "millimetres, where metres are known";
  EXPECT_EQ(depth_step(false, {}), 1e-3);
}

}  // namespace
}  // namespace semfield
