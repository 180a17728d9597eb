// Every format read back by a program that shares no code with the writers, and what cameras see of surfaces.
#include "surface/mesh/mesh_files.h"

#include <cstdlib>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/text.h"
#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/raycast.h"
#include "scene/camera_path.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/sights.h"
#include "surface/mesh/surface.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

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
      values[i] = 0.6 - dot(p, p);
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
    surface.attributes.instance.push_back(p.z < 1 ? 0 : p.y < -1 ? 4 : 9);
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
  want["instances"] = s.attributes.instance;
  want["triangles"] = s.triangles;
  // Groups by a rule of their own: the class of two corners, else of the surest corner.
  std::map<int, nlohmann::json> groups;
  std::map<std::pair<int, int>, nlohmann::json> primitives;  // by object, then by class
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
    int object = 0;
    if (!s.attributes.instance.empty()) {
      std::map<int, int> votes;
      for (const std::uint32_t v : t) ++votes[s.attributes.instance[v]];
      object = s.attributes.instance[t[0]];
      for (const auto& [candidate, count] : votes) object = count > 1 ? candidate : object;
    }
    primitives[{object, label}]["triangles"].push_back(t);
  }
  static const std::map<int, std::array<std::uint8_t, 3>> colors{
      {-1, {128, 128, 128}}, {0, {200, 100, 50}}, {1, {10, 20, 30}}, {2, {255, 255, 255}}};
  std::size_t n = 0;
  for (auto& [label, group] : groups) {
    group["name"] = names.at(n++);
    group["id"] = label < 0 ? -1 : ids.at(label);
    group["linear"] = linear(colors.at(label));
    want["groups"].push_back(group);
    for (auto& [key, primitive] : primitives) {
      if (key.second != label) continue;
      primitive["name"] = group["name"];
      primitive["id"] = group["id"];
      primitive["object"] = key.first;
    }
  }
  for (const auto& [key, primitive] : primitives) want["primitives"].push_back(primitive);
  want["objects"] = {{"4", "red chair"}, {"9", "object 9"}};
  ASSERT_EQ(n, names.size());
  write_file_atomic(path, want.dump());
}

void expect_read_back(bool semantics, const GlbLook& look, const std::vector<std::string>& names) {
  if (!python_found()) GTEST_SKIP() << "no python3 here: the mesh files were written but not read by another program";
  const TempDir dir;
  const Surface surface = ball(semantics);
  write_expected(dir / "expected.json", surface, look, names);
  write_ply(dir / "mesh.ply", surface, classes());
  write_ply(dir / "points.ply", PointSet{surface.positions, {}, {}, surface.attributes}, classes());
  write_obj(dir / "mesh.obj", surface, classes());
  write_glb(dir / "mesh.glb", surface, classes(), look);
  const std::string command =
      "python3 " + shell_word(SEMFIELD_SOURCE_DIR "/tests/mesh/read_mesh_files.py") + " " + shell_word(dir.path());
  EXPECT_EQ(std::system(command.c_str()), 0);
}

TEST(MeshFiles, AnotherProgramReadsWhatWasMeant) {
  expect_read_back(true, {{0, 0, 1}, true, {{4, "red chair"}}}, {"void", "wall", "dining_table", "dining_table_65535"});
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
  EXPECT_HAS(error_of([&] { write_ply("/proc/none/mesh.ply", ball(true), classes()); }), "/proc/none");
}

// What cameras see of surfaces whose shape is a formula.

constexpr double kCell = 0.04;

// Where `solid` is positive, in a cube of 3 m.
Surface surface_of(const std::function<double(Vec3d)>& solid) {
  const VoxelGrid grid = VoxelGrid::covering({{-1.5, -1.5, -1.5}, {1.5, 1.5, 1.5}}, kCell);
  Surface surface = marching_cubes(grid, 0, [&](std::int64_t z, std::span<double> values) {
    for (std::int64_t i = 0; i < grid.layer_points(); ++i)
      values[i] = solid(
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}));
  });
  set_vertex_normals(surface);
  return surface;
}

double ball_value(Vec3d p, Vec3d center, double radius) { return radius - length(p - center); }
// Walls around [-1, 1]^3.
double walls(Vec3d p) { return std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)}) - 1; }

RayCamera camera_at(Vec3d place, Vec3d towards) {
  const Vec3d up = std::abs(normalized(towards - place).z) > 0.9 ? Vec3d{0, 1, 0} : Vec3d{0, 0, 1};
  return {{160, 120, 100, 100, 80, 60}, look_along(place, normalized(towards - place), up), true};
}

// Cameras that look every way from a place.
std::vector<RayCamera> around(Vec3d place) {
  std::vector<RayCamera> out;
  for (int axis = 0; axis < 3; ++axis) {
    for (const double sign : {-1.0, 1.0}) {
      Vec3d ahead;
      ahead[axis] = sign;
      RayCamera camera = camera_at(place, place + ahead);
      camera.camera = {160, 160, 70, 70, 80, 80};
      out.push_back(camera);
    }
  }
  return out;
}

RayLimits limits() { return RayLimits{.near_m = 0.05, .far_m = 10}; }

Surface seen_of(Surface surface, const std::vector<RayCamera>& cameras) {
  keep_triangles(surface, triangles_in_sight(surface, sights_of(surface, cameras, limits(), kCell)));
  return surface;
}

// A room with a hollow behind one wall, which is where a field holds what it likes.
TEST(Sights, WhatLiesBehindAWallGoesAndTheRoomStaysWhole) {
  const Vec3d hollow{1.25, 0, 0};
  const auto solid = [&](Vec3d p) { return std::min(walls(p), -ball_value(p, hollow, 0.15)); };
  const Surface all = surface_of(solid), room = surface_of(walls);
  const Surface kept = seen_of(all, around({0.1, -0.2, 0.1}));
  EXPECT_GT(all.triangles.size(), room.triangles.size() + 100);
  EXPECT_EQ(kept.triangles.size(), room.triangles.size());
  for (const Vec3d& p : kept.positions) EXPECT_GT(length(p - hollow), 0.2);
}

// A pillar hides a part of the wall behind it.
TEST(Sights, OneCameraLeavesAShadowThatASecondOneFills) {
  const Vec3d pillar{0.3, 0, 0};
  const auto solid = [&](Vec3d p) { return std::max(walls(p), 0.3 - std::hypot(p.x - pillar.x, p.y - pillar.y)); };
  const Surface all = surface_of(solid);
  const RayCamera front = camera_at({-0.9, 0, 0}, {1, 0, 0});
  const auto in_shadow = [](const Surface& surface) {
    return std::count_if(surface.positions.begin(), surface.positions.end(),
                         [](const Vec3d& p) { return p.x > 0.99 && std::abs(p.y) < 0.3 && std::abs(p.z) < 0.5; });
  };
  ASSERT_GT(in_shadow(all), 200);
  const Surface one = seen_of(all, {front});
  EXPECT_EQ(in_shadow(one), 0);
  const bool beside = std::any_of(one.positions.begin(), one.positions.end(),
                                  [](const Vec3d& p) { return p.x > 0.99 && std::abs(p.y) > 0.85; });
  EXPECT_TRUE(beside) << "the wall beside the shadow is there";
  EXPECT_EQ(in_shadow(seen_of(all, {front, camera_at({0.8, -0.9, 0}, {1, 0, 0}), camera_at({0.8, 0.9, 0}, {1, 0, 0})})),
            in_shadow(all));
}

TEST(Sights, NoFringeIsLeftAtTheRimOfWhatIsSeen) {
  const Surface all = surface_of([](Vec3d p) { return ball_value(p, {0, 0, 0}, 1); });
  const RayCamera camera = camera_at({-4, 0, 0}, {0, 0, 0});
  const Surface kept = seen_of(all, {camera});
  ASSERT_FALSE(kept.positions.empty());
  // A camera at a distance of 4 sees the ball up to x = -1/4.
  for (const Vec3d& p : kept.positions) EXPECT_LT(p.x, -0.25 + 3 * kCell);
  const auto near_rim = std::count_if(kept.positions.begin(), kept.positions.end(),
                                      [](const Vec3d& p) { return p.x > -0.25 - 3 * kCell; });
  EXPECT_GT(near_rim, 100) << "and little of it is missing";
}

// What stands on a table is seen from all sides but one.
TEST(Sights, AnObjectThatIsSeenButForALittleStaysClosed) {
  const auto solid = [](Vec3d p) { return std::min(ball_value(p, {0, 0, 0}, 1), p.z + 0.85); };
  const Surface all = surface_of(solid);
  std::vector<RayCamera> cameras;
  for (int i = 0; i < 8; ++i) cameras.push_back(camera_at({3 * std::cos(i * 0.785), 3 * std::sin(i * 0.785), 0.5}, {}));
  cameras.push_back(camera_at({0.01, 0, 3}, {}));
  const std::vector<Sights> sights = sights_of(all, cameras, limits(), kCell);
  std::int64_t below = 0, unseen = 0;
  for (std::size_t v = 0; v < sights.size(); ++v) {
    if (all.positions[v].z > -0.84 || std::hypot(all.positions[v].x, all.positions[v].y) > 0.45) continue;
    ++below;
    unseen += sights[v].any() ? 0 : 1;
  }
  ASSERT_GT(below, 200);
  EXPECT_EQ(unseen, below);
  EXPECT_EQ(seen_of(all, cameras).triangles.size(), all.triangles.size());
}

TEST(Sights, AreTheCamerasThatShowAPointLargestAndLendThemselves) {
  const Surface all = surface_of([](Vec3d p) { return ball_value(p, {0, 0, 0}, 1); });
  const std::vector<RayCamera> cameras{camera_at({-4, 0, 0}, {}), camera_at({-2.5, 0, 0}, {}), camera_at({4, 0, 0}, {}),
                                       camera_at({-3, 1, 0}, {}), camera_at({-3, -1, 0}, {})};
  std::vector<Sights> sights = sights_of(all, cameras, limits(), kCell);
  const auto vertex = [&](Vec3d wanted) {
    const auto nearest =
        std::min_element(all.positions.begin(), all.positions.end(),
                         [&](const Vec3d& a, const Vec3d& b) { return length(a - wanted) < length(b - wanted); });
    return static_cast<std::size_t>(nearest - all.positions.begin());
  };
  const std::size_t left = vertex({-1, 0, 0}), right = vertex({1, 0, 0}), top = vertex({0, 0, 1});
  EXPECT_EQ(sights[left].camera[0], 1) << "the nearest";
  EXPECT_TRUE(std::is_sorted(sights[left].weight.rbegin(), sights[left].weight.rend()));
  EXPECT_GE(sights[left].camera[2], 0);
  EXPECT_EQ(sights[right].camera, (std::array<std::int32_t, 3>{2, -1, -1}));
  EXPECT_FALSE(sights[top].any());

  const Looks facing = looks_at(all.positions[right], all.normals[right], sights[right], cameras);
  ASSERT_EQ(facing.count, 1U);
  EXPECT_LT(length(facing.direction[0] - Vec3d{-1, 0, 0}), 0.05);
  EXPECT_EQ(facing.weight[0], 1);
  const Looks three = looks_at(all.positions[left], all.normals[left], sights[left], cameras);
  ASSERT_EQ(three.count, 3U);
  EXPECT_NEAR(three.weight[0] + three.weight[1] + three.weight[2], 1, 1e-12);
  const Looks nobody = looks_at(all.positions[top], all.normals[top], sights[top], cameras);
  EXPECT_EQ(nobody.direction[0], all.normals[top] * -1.0);

  lend_sights(all, sights);
  EXPECT_TRUE(std::all_of(sights.begin(), sights.end(), [](const Sights& s) { return s.any(); }));
  // A camera that was lent may look at the back: then nobody's direction is taken.
  const Looks back = looks_at({0, 0, 0}, {1, 0, 0}, Sights{{0, -1, -1}, {1, 0, 0}}, cameras);
  EXPECT_EQ(back.direction[0], (Vec3d{-1, 0, 0}));
}

TEST(Sights, FollowTheLensAndTheLimitsAndNotTheThreads) {
  const Surface all = surface_of([](Vec3d p) { return std::max(walls(p), ball_value(p, {0, 0, 0}, 0.3)); });
  std::vector<RayCamera> cameras = around({-0.7, 0.1, 0});
  const auto flags = [&](const RayLimits& most) {
    std::vector<char> out;
    for (const Sights& s : sights_of(all, cameras, most, kCell)) out.push_back(s.any() ? 1 : 0);
    return out;
  };
  const std::vector<char> wide = flags(limits());
  RayLimits short_sighted = limits();
  short_sighted.far_m = 1;
  const std::vector<char> near = flags(short_sighted);
  for (std::size_t v = 0; v < all.positions.size(); ++v) {
    if (near[v] == 0) continue;
    EXPECT_LE(length(all.positions[v] - Vec3d{-0.7, 0.1, 0}), 1 + 1e-9);
  }
  // A barrel lens sees further to the side than the pinhole of its focal length.
  cameras.resize(1);
  const std::vector<char> pinhole = flags(limits());
  cameras[0].camera.k1 = -0.2;
  const std::vector<char> barrel = flags(limits());
  cameras[0].undistort = false;
  EXPECT_EQ(flags(limits()), pinhole) << "whoever does not undistort, casts rays of a pinhole";
  const auto count = [](const std::vector<char>& of) { return std::count(of.begin(), of.end(), 1); };
  EXPECT_GT(count(barrel), count(pinhole) + 100);

  cameras = around({-0.7, 0.1, 0});
  const int threads = thread_count();
  set_thread_count(1);
  EXPECT_EQ(flags(limits()), wide);
  set_thread_count(threads);
}

}  // namespace
}  // namespace semfield
