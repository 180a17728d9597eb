// Every format is read back by a program that shares no code with the writers.
#include "surface/mesh/mesh_files.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <map>
#include <nlohmann/json.hpp>

#include "core/text.h"
#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/raycast.h"
#include "scene/camera_path.h"
#include "surface/mesh/class_groups.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/upright.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using testing_train::TempDir;

bool python_found() { return std::system("python3 -c 'import json, struct' >/dev/null 2>&1") == 0; }

// Ids over 255, a name of two words, two names that become one, and void with an id of its own.
ClassTable classes() {
  return ClassTable({{7, "void", {0, 0, 0}, true},
                     {3, "wall", {200, 100, 50}, false},
                     {300, "dining table", {10, 20, 30}, false},
                     {65535, "dining_table", {255, 255, 255}, false}});
}

// A ball at coordinates that 32 bits cannot hold, labelled by height.
Surface ball(bool semantics) {
  const VoxelGrid grid = VoxelGrid::covering({{999, -2, 0}, {1001, 0, 2}}, 0.25);
  Surface surface = marching_cubes(grid, 0, [&](std::int64_t z, std::span<double> values) {
    for (std::int64_t i = 0; i < grid.layer_points(); ++i) {
      const Vec3d p =
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}) -
          Vec3d{1000, -1, 1};
      values[static_cast<std::size_t>(i)] = 0.6 - dot(p, p);
    }
  });
  set_vertex_normals(surface);
  for (const Vec3d& p : surface.positions) {
    const auto shade = static_cast<std::uint8_t>(std::lround(120 * p.z));
    surface.attributes.color.push_back({shade, static_cast<std::uint8_t>(255 - shade), 17});
    if (!semantics) continue;
    const auto slice = static_cast<std::int16_t>(std::floor(2.2 * (p.z - 0.2)));
    surface.attributes.label.push_back(static_cast<std::int16_t>(std::clamp(slice - 1, -1, 2)));
    surface.attributes.entropy.push_back(static_cast<float>(std::abs(p.x - 1000)));
  }
  return surface;
}

nlohmann::json linear(const std::array<std::uint8_t, 3>& color) {
  return {linear_light(color[0]), linear_light(color[1]), linear_light(color[2])};
}

void write_expected(const std::string& path, const Surface& s, const GlbLook& look,
                    const std::vector<std::string>& names) {
  nlohmann::json want;
  want["up"] = {look.up.x, look.up.y, look.up.z};
  want["unlit"] = look.unlit;
  for (std::size_t v = 0; v < s.positions.size(); ++v) {
    want["positions"].push_back({s.positions[v].x, s.positions[v].y, s.positions[v].z});
    want["normals"].push_back({s.normals[v].x, s.normals[v].y, s.normals[v].z});
    want["colors"].push_back(s.attributes.color[v]);
    want["linear_colors"].push_back(linear(s.attributes.color[v]));
  }
  static const std::map<int, int> ids{{-1, 7}, {0, 3}, {1, 300}, {2, 65535}};
  want["ids"] = nlohmann::json::array();
  for (const std::int16_t label : s.attributes.label) want["ids"].push_back(ids.at(label));
  want["entropy"] = s.attributes.entropy;
  want["triangles"] = s.triangles;
  // Groups by a rule of their own: the class of two corners, else of the surest corner.
  std::map<int, nlohmann::json> groups;
  for (const Triangle& t : s.triangles) {
    int label = -1;
    if (!s.attributes.label.empty()) {
      std::map<int, int> votes;
      for (const std::uint32_t v : t) ++votes[s.attributes.label[v]];
      std::uint32_t surest = t[0];
      for (const std::uint32_t v : t) surest = s.attributes.entropy[v] < s.attributes.entropy[surest] ? v : surest;
      label = s.attributes.label[surest];
      for (const auto& [candidate, count] : votes) label = count > 1 ? candidate : label;
    }
    groups[label]["triangles"].push_back(t);
  }
  static const std::map<int, std::array<std::uint8_t, 3>> colors{
      {-1, {128, 128, 128}}, {0, {200, 100, 50}}, {1, {10, 20, 30}}, {2, {255, 255, 255}}};
  std::size_t n = 0;
  for (auto& [label, group] : groups) {
    group["name"] = names.at(n++);
    group["id"] = label < 0 ? -1 : ids.at(label);
    group["linear"] = linear(colors.at(label));
    want["groups"].push_back(group);
  }
  ASSERT_EQ(n, names.size());
  write_file_atomic(path, want.dump());
}

void expect_read_back(bool semantics, const GlbLook& look, const std::vector<std::string>& names) {
  if (!python_found()) GTEST_SKIP() << "no python3 here: the mesh files were written but not read by another program";
  const TempDir dir;
  const Surface surface = ball(semantics);
  write_expected(dir / "expected.json", surface, look, names);
  write_ply(dir / "mesh.ply", surface, classes());
  write_ply(dir / "points.ply", PointSet{surface.positions, surface.attributes}, classes());
  write_obj(dir / "mesh.obj", surface, classes());
  write_glb(dir / "mesh.glb", surface, classes(), look);
  const std::string command =
      "python3 " + shell_word(SEMFIELD_SOURCE_DIR "/tests/mesh/read_mesh_files.py") + " " + shell_word(dir.path());
  EXPECT_EQ(std::system(command.c_str()), 0);
}

TEST(MeshFiles, AnotherProgramReadsWhatWasMeant) {
  expect_read_back(true, {{0, 0, 1}, true}, {"void", "wall", "dining_table", "dining_table_65535"});
}

TEST(MeshFiles, WithoutSemanticsThereIsOneMaterial) {
  for (const Vec3d up : {Vec3d{0, 1, 0}, {0, -1, 0}, {-1, 0, 0}, {0, 0, -1}, normalized(Vec3d{0.3, -0.9, 0.2})})
    expect_read_back(false, {up, false}, {"surface"});
}

TEST(MeshFiles, ClassColorsAreThoseOfTheTable) {
  const Surface surface = ball(true);
  const auto colors = class_colors(surface.attributes, classes());
  ASSERT_EQ(colors.size(), surface.positions.size());
  static const std::map<int, std::array<std::uint8_t, 3>> table{
      {-1, {128, 128, 128}}, {0, {200, 100, 50}}, {1, {10, 20, 30}}, {2, {255, 255, 255}}};
  std::map<int, int> seen;
  for (std::size_t v = 0; v < colors.size(); ++v) {
    EXPECT_EQ(colors[v], table.at(surface.attributes.label[v])) << v;
    ++seen[surface.attributes.label[v]];
  }
  EXPECT_EQ(seen.size(), 4U);
}

// Cameras around a room, pitched by turns, in a world with another axis upright.
TEST(Upright, CamerasTellTheAxisThatTheyStandAlong) {
  for (const char* name : {"x", "-x", "y", "-y", "z", "-z"}) {
    const Vec3d up = *axis_named(name);
    const LevelAxes axes = level_axes(up);
    std::vector<Pose> poses;
    for (int i = 0; i < 12; ++i) poses.push_back(look_along({}, axes.direction(0.9 * i, 0.15 * (i % 5) - 0.5), up));
    EXPECT_EQ(up_of_cameras(poses), up) << name;
    EXPECT_EQ(axis_text(up), (name[0] == '-' ? "" : "+") + std::string(name));
  }
}

TEST(Upright, ATiltedWorldKeepsItsDirectionAndCamerasThatCancelTellNothing) {
  const Vec3d up = normalized(Vec3d{1, 2, 2});
  EXPECT_NEAR(length(*up_of_cameras(std::vector{look_along({}, {2, -1, 0}, up)}) - up), 0, 1e-12);
  EXPECT_EQ(axis_text(up), "(0.333, 0.667, 0.667)");
  const std::vector<Pose> against{look_along({}, {1, 0, 0}, {0, 0, 1}), look_along({}, {1, 0, 0}, {0, 0, -1})};
  EXPECT_FALSE(up_of_cameras(against));
  EXPECT_FALSE(up_of_cameras({}));
  for (const char* none : {"", "w", "+", "-", "xy", "--x", "Y"}) EXPECT_FALSE(axis_named(none)) << none;
}

TEST(MeshFiles, TheHousesOwnObjReaderAgrees) {
  if (!raycast_available()) GTEST_SKIP() << "this build reads no meshes";
  const TempDir dir;
  const Surface surface = ball(true);
  write_obj(dir / "mesh.obj", surface, classes());
  Diagnostics diagnostics;
  const TriangleMesh mesh = load_obj(dir / "mesh.obj", diagnostics);
  EXPECT_TRUE(diagnostics.all().empty()) << diagnostics.all().front().text();
  EXPECT_EQ(mesh.size() + static_cast<std::size_t>(mesh.zero_area_skipped), surface.triangles.size());
  ASSERT_EQ(mesh.materials.size(), 4U);
  EXPECT_EQ(mesh.materials[2].name, "dining_table");
  EXPECT_NEAR(mesh.materials[1].diffuse[0], linear_light(200), 1e-5);
}

TEST(MeshFiles, ClassGroupsHoldEveryTriangleOnce) {
  const Surface surface = ball(true);
  std::size_t triangles = 0;
  for (const ClassGroup& group : class_groups(surface, classes())) triangles += group.triangles.size();
  EXPECT_EQ(triangles, surface.triangles.size());
}

TEST(MeshFiles, AFolderThatIsNotThereIsAnErrorWithThePath) {
  try {
    write_ply("/proc/none/mesh.ply", ball(true), classes());
    FAIL();
  } catch (const Error& error) {
    EXPECT_NE(error.message().find("/proc/none"), std::string::npos) << error.message();
  }
}

}  // namespace
}  // namespace semfield
