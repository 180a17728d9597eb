// The dataset on the shipped room, on rooms with faults, and on other people's rooms where they are at hand.
#include "datasets/obj_room/obj_room.h"

#include <algorithm>
#include <map>
#include <set>

#include "datasets/obj_room/tests/obj_testing.h"
#include "tests/datasets/rewritten_poses.h"

namespace semfield {
namespace {

using namespace testing_obj;
namespace fs = std::filesystem;

ObjRoomParams small(const std::string& root, int width = 40, int height = 30) {
  return ObjRoomParams{.root = root,
                       .width_px = width,
                       .height_px = height,
                       .frames = 4,
                       .test_frames = 2,
                       .supersample = 1,
                       .occlusion_rays = 2,
                       .shadow_rays = 1};
}

const std::string kShipped = std::string(SEMFIELD_SOURCE_DIR) + "/scenes/room";

/// Problems of a scene just opened, and its frames against what any scene promises.
void check_frames(ObjRoom& room, const SceneInfo& info, int total) {
  ASSERT_EQ(static_cast<int>(info.frames.size()), total);
  FrameBuffer f;
  std::set<std::int16_t> seen;
  std::int64_t hit = 0, pixels = 0;
  for (int i = 0; i < total; ++i) {
    room.read(i, f);
    for (std::size_t k = 0; k < f.label.size(); ++k) {
      ASSERT_GE(f.label[k], kVoid);
      ASSERT_LT(f.label[k], info.classes.valid_count());
      ASSERT_TRUE(std::isfinite(f.depth_m[k]));
      ASSERT_EQ(f.depth_m[k] > 0, f.instance[k] > 0);
      if (f.label[k] >= 0) seen.insert(f.label[k]);
      hit += f.depth_m[k] > 0 ? 1 : 0;
      ++pixels;
    }
  }
  EXPECT_GE(seen.size(), 4u);
  EXPECT_GT(hit, pixels * 8 / 10);
}

TEST(ObjRoomShipped, IsRichSmallAndWithoutFault) {
  ObjRoomParams p = small(kShipped);
  p.frames = 12;
  p.test_frames = 4;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  EXPECT_GE(info.classes.valid_count(), 12);
  check_frames(room, info, 16);
  EXPECT_GT(info.near_hint_m, 0);
  EXPECT_GT(info.far_hint_m, info.near_hint_m);

  const TriangleMesh mesh = load_obj(kShipped + "/room.obj", d);
  EXPECT_GE(mesh.objects.size(), 25u);
  const auto of_class = [&](const std::string& name) {
    return std::count_if(mesh.objects.begin(), mesh.objects.end(),
                         [&](const std::string& o) { return matches_glob(o, name + "_*"); });
  };
  EXPECT_GE(of_class("chair"), 2);
  std::set<std::int16_t> used;
  const ClassRules rules = load_class_rules(kShipped + "/classes.yaml");
  for (const std::int16_t c : classes_of_mesh(mesh, rules, d)) used.insert(c);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(used.count(kVoid), 0u);
  EXPECT_GE(used.size(), 12u);
  EXPECT_LE(static_cast<int>(used.size()), rules.table.valid_count());

  std::uintmax_t bytes = 0;
  for (const auto& entry : fs::recursive_directory_iterator(kShipped)) {
    if (entry.is_regular_file()) bytes += entry.file_size();
  }
  EXPECT_LT(bytes, 3u << 20);
}

TEST(ObjRoomShipped, TrainAndTestFramesAreDistinctAndSpread) {
  ObjRoomParams p = small(kShipped, 8, 6);
  p.frames = 30;
  p.test_frames = 10;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  std::set<std::string> names;
  std::set<std::array<double, 6>> poses;
  int train = 0, test = 0;
  for (const FrameInfo& f : info.frames) {
    const Pose& w = f.world_from_camera;
    names.insert(f.name);
    poses.insert({w.t.x, w.t.y, w.t.z, w.r[0][2], w.r[1][2], w.r[2][2]});
    train += f.split == Split::train ? 1 : 0;
    test += f.split == Split::test ? 1 : 0;
    EXPECT_TRUE(f.has_depth && f.has_labels && f.has_instances);
  }
  EXPECT_EQ(train, 30);
  EXPECT_EQ(test, 10);
  EXPECT_EQ(names.size(), 40u);
  EXPECT_EQ(poses.size(), 40u);
  // One test frame in every four.
  for (std::size_t i = 0; i < 40; i += 4) {
    int here = 0;
    for (std::size_t k = i; k < i + 4; ++k) here += info.frames[k].split == Split::test ? 1 : 0;
    EXPECT_EQ(here, 1) << "frames from " << i;
  }
}

/// A folder with the closed-form room and six cameras on a slide along +x that look along +y.
std::string room_folder() {
  const std::string folder = fresh_folder("room");
  plain_write(folder + "/room.obj", room_text());
  plain_write(folder + "/classes.yaml", kRoomClasses);
  std::string cameras;
  for (int i = 0; i < 6; ++i) cameras += "1 0 0 " + std::to_string(-0.5 + 0.2 * i) + " 0 0 1 -1 0 -1 0 1.2\n";
  plain_write(folder + "/cameras.txt", cameras);
  return folder;
}

TEST(ObjRoom, CamerasOfAFileAndBoundsFromWhatTheyMeet) {
  ObjRoomParams p = small(room_folder());
  p.cameras = "cameras.txt";
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  ASSERT_EQ(info.frames.size(), 6u);
  EXPECT_NEAR(info.frames[3].world_from_camera.t.x, 0.1, 1e-9);
  EXPECT_EQ(info.frames[3].world_from_camera.axis(2), (Vec3d{0, 1, 0}));
  EXPECT_NEAR(info.frames[0].camera.fx, 20, 1e-9);  // 90 degrees over 40 pixels
  for (int a = 0; a < 3; ++a) {
    EXPECT_GE(info.bounds.lo[a], kRoom.lo[a] - 0.051);
    EXPECT_LE(info.bounds.hi[a], kRoom.hi[a] + 0.051);
  }
  EXPECT_NEAR(info.bounds.hi.y, 1.55, 1e-6);
  FrameBuffer f;
  room.read(2, f);
  const Vec3d c = info.frames[2].world_from_camera.t, axis = info.frames[2].camera.direction(20.5, 20.5);
  EXPECT_NEAR(f.depth_m[20 * 40 + 20], room_truth(c, info.frames[2].world_from_camera.rotate(axis)).distance * axis.z,
              1e-5);
  EXPECT_EQ(error_of([&] { room.read(6, f); }), "frame 6 of 6 was asked for");
}

// Every side of the crate, and every wall, is an object of its own in the file.
TEST(ObjRoom, InstancesAreObjectsOfTheFileOrPieces) {
  ObjRoomParams p = small(room_folder());
  p.cameras = "cameras.txt";
  const auto instances = [&] {  // of each class
    ObjRoom room(p, {});
    Diagnostics d;
    const SceneInfo info = room.open(d);
    std::map<std::string, std::set<std::int32_t>> out;
    FrameBuffer f;
    for (int i = 0; i < static_cast<int>(info.frames.size()); ++i) {
      room.read(i, f);
      for (std::size_t k = 0; k < f.label.size(); ++k)
        if (f.label[k] >= 0) out[info.classes.valid(f.label[k]).name].insert(f.instance[k]);
    }
    return out;
  };
  EXPECT_GE(instances().at("crate").size(), 2u);
  EXPECT_GE(instances().at("wall").size(), 3u);
  p.instances = RoomInstances::pieces;
  std::set<std::int32_t> all;
  for (const auto& [name, ids] : instances()) {
    EXPECT_EQ(ids.size(), 1u) << name;
    all.insert(ids.begin(), ids.end());
  }
  EXPECT_EQ(all.size(), instances().size()) << "pieces of two classes have two numbers";
}

TEST(ObjRoom, GivenNearFarAndBoundsHold) {
  ObjRoomParams p = small(room_folder());
  p.bounds = {-2, -1.5, 0, 0, 1.5, 2.5};
  p.near_m = 0.2;
  p.far_m = 7;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  EXPECT_EQ(info.near_hint_m, 0.2);
  EXPECT_EQ(info.far_hint_m, 7);
  for (const FrameInfo& f : info.frames) EXPECT_LE(f.world_from_camera.t.x, 0.35);
}

TEST(ObjRoom, WhatIsMissingIsNamed) {
  const std::string folder = room_folder();
  const auto message = [&](const ObjRoomParams& p) {
    return error_of([&] {
      Diagnostics d;
      ObjRoom(p, {}).open(d);
    });
  };
  EXPECT_EQ(message(small(folder + "/none")), "no folder '" + folder + "/none'; set scene.root to the room's folder");
  ObjRoomParams p = small(folder);
  p.cameras = "cameras.txt";
  p.frames = 7;
  EXPECT_EQ(message(p), folder +
                            "/cameras.txt: holds 6 poses, frames + test_frames asks for 9; lower scene.frames or "
                            "scene.test_frames");
  plain_write(folder + "/other.obj", room_text());
  EXPECT_EQ(message(small(folder)),
            "several OBJ files in '" + folder + "': other.obj, room.obj; set scene.obj to one of them");
  p = small(folder);
  p.obj = "other.obj";
  EXPECT_EQ(message(p), "");
  fs::remove(folder + "/classes.yaml");
  EXPECT_EQ(message(p), "no classes.yaml or classes.csv in '" + folder +
                            "'; write one ({classes: [...], rules: [...]}) or set scene.classes");
  const std::string empty = fresh_folder("empty");
  EXPECT_EQ(message(small(empty)), "no OBJ file in '" + empty + "'; put one there or set scene.obj");
}

TEST(ObjRoom, ObjectsWithoutAClassAreErrorsOfTheScene) {
  const std::string folder = room_folder();
  plain_write(folder + "/classes.yaml", "- {id: 1, name: wall}\n- {id: 4, name: crate}\n");
  ObjRoom room(small(folder), {});
  Diagnostics d;
  room.open(d);
  EXPECT_EQ(d.error_count(), 2);
  EXPECT_EQ(d.all()[0].where, "object 'floor_1'");
  EXPECT_EQ(d.all()[1].where, "object 'ceiling_1'");
}

TEST(ObjRoom, SettingsThatContradictAreNamed) {
  ObjRoomParams p{.lowest_m = 2, .bounds = {0, 0, 0, 1, -1, 1}, .near_m = 3, .far_m = 2};
  Diagnostics d;
  validate(p, d);
  p.bounds = {1, 2};
  validate(p, d);
  EXPECT_EQ(d.error_count(), 6);
  EXPECT_EQ(d.all()[2].text(),
            "bounds: has a least corner that is not below the greatest; give [xmin, ymin, zmin, xmax, ymax, zmax]");
  EXPECT_EQ(d.all()[5].text(), "bounds: has 2 numbers; give [xmin, ymin, zmin, xmax, ymax, zmax]");
}

std::string data(const std::string& name) { return std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/" + name; }

void expect_no_errors(const Diagnostics& d) {
  for (const Diagnostic& x : d.all()) EXPECT_NE(x.severity, Severity::error) << x.text();
}

TEST(ObjRoomOthers, LivingRoom) {
  if (!fs::exists(data("obj_living_room"))) GTEST_SKIP() << "the optional living room is not at hand";
  ObjRoomParams p = small(data("obj_living_room"), 32, 24);
  p.up = UpAxis::y;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  expect_no_errors(d);
  EXPECT_EQ(info.classes.valid_count(), 16);
  check_frames(room, info, 6);
}

TEST(ObjRoomOthers, Classroom) {
  if (!fs::exists(data("obj_classroom"))) GTEST_SKIP() << "the optional classroom is not at hand";
  ObjRoomParams p = small(data("obj_classroom"), 32, 24);
  p.up = UpAxis::y;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  expect_no_errors(d);
  EXPECT_EQ(info.classes.valid_count(), 19);
  check_frames(room, info, 6);
}

TEST(ObjRoomShipped, PoseConventionsAreTold) {
  ObjRoomParams p = small(kShipped, 64, 48);
  p.frames = 16;
  ObjRoom room(p, {});
  expect_conventions_told(room, "poses agree with depth");
}

TEST(ObjRoomOthers, PoseConventionsAreTold) {
  for (const char* name : {"obj_living_room", "obj_classroom"}) {
    if (!fs::exists(data(name))) GTEST_SKIP() << "the optional OBJ rooms are not at hand";
    ObjRoomParams p = small(data(name), 64, 48);
    p.up = UpAxis::y;
    p.frames = 16;
    ObjRoom room(p, {});
    expect_conventions_told(room, "poses agree with depth");
  }
}

TEST(ObjRoomOthers, SceneNetRoomWithItsTrajectory) {
  if (!fs::exists(data("obj_scenenet_room89"))) GTEST_SKIP() << "the optional SceneNet room is not at hand";
  // The room comes without a class table: rules by pattern, and a class for the rest.
  const std::string folder = fresh_folder("classes");
  plain_write(folder + "/rules.yaml",
              "classes:\n  - {id: 1, name: chair}\n  - {id: 2, name: table}\n  - {id: 3, name: floor}\n"
              "  - {id: 4, name: wall}\n  - {id: 5, name: other}\nrules:\n  - {object: \"chair*\", class: chair}\n"
              "  - {object: \"*able*\", class: table}\n  - {object: \"floor*\", class: floor}\n"
              "  - {object: \"*wall*\", class: wall}\n  - {object: \"*\", class: other}\n");
  ObjRoomParams p = small(data("obj_scenenet_room89"), 32, 24);
  p.up = UpAxis::y;
  p.classes = folder + "/rules.yaml";
  p.cameras = "room_89_simple_trajectory_random_poses_SE3_3x4.txt";
  p.camera_axes = CameraAxes::right_up_backward;
  ObjRoom room(p, {});
  Diagnostics d;
  const SceneInfo info = room.open(d);
  expect_no_errors(d);
  check_frames(room, info, 6);
}

}  // namespace
}  // namespace semfield
