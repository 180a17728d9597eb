// What a generated camera path promises.
#include "datasets/obj_room/room_path.h"

#include <gtest/gtest.h>

#include "datasets/obj_room/tests/obj_testing.h"

namespace semfield {
namespace {

using namespace testing_obj;

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
  Diagnostics d;
  return load_text(obj.str(), d);
}

PathSettings settings_of(const TriangleMesh& mesh, int poses, std::uint64_t seed) {
  PathSettings s;
  s.poses = poses;
  s.seed = seed;
  s.region = mesh.bounds;
  return s;
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
  Diagnostics d;
  const TriangleMesh mesh = load_text(obj.str(), d);
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

TEST(RoomPath, SeedDecides) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  const std::vector<Pose> a = make_camera_path(rays, settings_of(mesh, 24, 5)),
                          b = make_camera_path(rays, settings_of(mesh, 24, 5)),
                          c = make_camera_path(rays, settings_of(mesh, 24, 6));
  int equal = 0, other = 0;
  for (std::size_t i = 0; i < 24; ++i) {
    equal += same(a[i], b[i]) ? 1 : 0;
    other += same(a[i], c[i]) ? 1 : 0;
  }
  EXPECT_EQ(equal, 24);
  EXPECT_EQ(other, 0);
}

TEST(RoomPath, UpMayBeY) {
  Diagnostics d;
  std::ostringstream obj;
  int vertices = 0;
  add_box(obj, {{-2, 0, -1.5}, {2, 2.5, 1.5}}, {"a", "b", "c", "d", "e", "f"}, vertices);
  const TriangleMesh mesh = load_text(obj.str(), d);
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

TEST(RoomPath, NoFreeSpaceIsAnError) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  PathSettings s = settings_of(mesh, 4, 1);
  s.clearance_m = 2;
  const std::string remedy = "; lower scene.clearance_m or set scene.bounds to the inside of the room";
  EXPECT_EQ(error_of([&] { make_camera_path(rays, s); }),
            "no free space for cameras: 0 of 4000 positions are free" + remedy);
  // Outside there is space, but no room around it.
  s = settings_of(mesh, 4, 1);
  s.region = {{10, 10, 0}, {14, 14, 3}};
  EXPECT_EQ(error_of([&] { make_camera_path(rays, s); }),
            "no free space for cameras: 0 of 4000 positions are free" + remedy);
}

}  // namespace
}  // namespace semfield
