// Voxels that rays free and fill, and maps of what stands above a floor.
#include "handover/voxel_map.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

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

}  // namespace
}  // namespace semfield
