// Surfaces of known solids: closed, oriented, accurate to second order; every sign pattern, random ones too.

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <set>

#include "app/render/run_surface.h"
#include "core/rng.h"
#include "datasets/obj_room/obj_room.h"
#include "scene/camera.h"
#include "scene/camera_rig.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/shape/simplify.h"
#include "surface/mesh/shape/smooth_borders.h"
#include "surface/mesh/sights.h"
#include "surface/mesh/surface.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "tests/threads.h"

namespace semfield {
namespace {

using Solid = std::function<double(Vec3d)>;

Surface surface_of(const VoxelGrid& grid, const Solid& solid, double level = 0) {
  Surface surface = marching_cubes(grid, level, [&](std::int64_t z, std::span<double> values) {
    ASSERT_EQ(static_cast<std::int64_t>(values.size()), grid.layer_points());
    for (std::int64_t i = 0; i < grid.layer_points(); ++i)
      values[i] = solid(
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}));
  });
  set_vertex_normals(surface);
  return surface;
}

double volume(const Surface& surface) {
  double sum = 0;
  for (const Triangle& t : surface.triangles)
    sum += dot(surface.positions[t[0]], cross(surface.positions[t[1]], surface.positions[t[2]])) / 6;
  return sum;
}

bool on_border(const VoxelGrid& grid, Vec3d p) {
  const std::int64_t last[3] = {grid.nx - 1, grid.ny - 1, grid.nz - 1};
  for (int axis = 0; axis < 3; ++axis) {
    const double index = (p[axis] - grid.origin[axis]) / grid.spacing;
    if (index < 1e-9 || index > static_cast<double>(last[axis]) - 1e-9) return true;
  }
  return false;
}

// Of each pair of vertices, how often one triangle runs from the first to the second.
std::map<std::pair<std::uint32_t, std::uint32_t>, int> sides_of(const Surface& surface) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> sides;
  for (const Triangle& t : surface.triangles)
    for (std::size_t k = 0; k < 3; ++k) ++sides[{t[k], t[(k + 1) % 3]}];
  return sides;
}

// Every edge: once in each direction, or on the border of the grid. Returns V - E + F.
std::int64_t expect_closed(const Surface& surface, const VoxelGrid& grid, bool border_allowed) {
  const auto directed = sides_of(surface);
  std::set<std::uint32_t> used;
  std::int64_t edges = 0, open = 0;
  for (const auto& [edge, count] : directed) {
    EXPECT_NE(edge.first, edge.second);
    EXPECT_EQ(count, 1) << "two triangles run along an edge in the same direction";
    used.insert(edge.first);
    const bool both = directed.count({edge.second, edge.first}) != 0;
    edges += both && edge.first > edge.second ? 0 : 1;
    if (both) continue;
    ++open;
    EXPECT_TRUE(border_allowed && on_border(grid, surface.positions[edge.first]) &&
                on_border(grid, surface.positions[edge.second]))
        << "a crack inside the grid";
  }
  EXPECT_EQ(used.size(), surface.positions.size()) << "a vertex without a triangle";
  EXPECT_TRUE(border_allowed || open == 0) << open;
  return static_cast<std::int64_t>(surface.positions.size()) - edges +
         static_cast<std::int64_t>(surface.triangles.size());
}

VoxelGrid unit_grid(double spacing) { return VoxelGrid::covering({{-1, -1.2, -0.9}, {1.1, 1, 1}}, spacing); }

const Vec3d kCenter{0.03, -0.11, 0.07};
constexpr double kRadius = 0.61;
double ball(Vec3d p) { return kRadius * kRadius - dot(p - kCenter, p - kCenter); }
struct SphereErrors {
  double radius = 0, normal = 0, volume = 0;
};

SphereErrors sphere_errors(double spacing) {
  const VoxelGrid grid = unit_grid(spacing);
  const Surface surface = surface_of(grid, ball);
  EXPECT_EQ(expect_closed(surface, grid, false), 2);
  SphereErrors errors;
  for (std::size_t v = 0; v < surface.positions.size(); ++v) {
    const Vec3d out = surface.positions[v] - kCenter;
    errors.radius = std::max(errors.radius, std::abs(length(out) - kRadius));
    errors.normal = std::max(errors.normal, length(surface.normals[v] - normalized(out)));
  }
  errors.volume = std::abs(volume(surface) - 4.0 / 3 * 3.141592653589793 * kRadius * kRadius * kRadius);
  return errors;
}

TEST(MarchingCubes, SphereConvergesAtOrderTwo) {
  const SphereErrors coarse = sphere_errors(0.1), fine = sphere_errors(0.05), finest = sphere_errors(0.025);
  EXPECT_LT(coarse.radius, 0.1 * 0.1);
  EXPECT_LT(finest.radius, 0.025 * 0.025);
  EXPECT_GT(coarse.radius / fine.radius, 3);
  EXPECT_GT(fine.radius / finest.radius, 3);
  EXPECT_GT(coarse.volume / finest.volume, 12) << "16 at order two";
  EXPECT_LT(finest.normal, 0.1) << "normals point outward";
  EXPECT_GT(finest.radius, 0);
}

TEST(MarchingCubes, EveryPatternIsClosedAmongItsNeighbours) {
  // The pattern in the middle of a grid whose other points are empty, then dense.
  for (unsigned pattern = 0; pattern < 256; ++pattern) {
    for (const double around : {-1.0, 1.0}) {
      const VoxelGrid grid{{0, 0, 0}, 1, 4, 4, 4};
      const Surface surface = surface_of(grid, [&](Vec3d p) {
        const auto x = static_cast<int>(p.x) - 1, y = static_cast<int>(p.y) - 1, z = static_cast<int>(p.z) - 1;
        if ((x | y | z) < 0 || (x | y | z) > 1) return around;
        return (pattern >> (x + 2 * y + 4 * z) & 1) != 0 ? 1.0 : -1.0;
      });
      expect_closed(surface, grid, false);
      if (::testing::Test::HasFailure()) FAIL() << "pattern " << pattern << " in " << around;
    }
  }
}

TEST(MarchingCubes, ThreadsChangeNeitherVerticesNorTriangles) {
  const VoxelGrid grid{{-3, 5, 0.5}, 0.25, 130, 111, 5};  // layers of several strips
  const auto surface_on = [&](int threads) {
    const ThreadScope scope(threads);
    std::uint64_t n = 0;
    const RandomAddress address{7, 0, stream_id("mesh_test/field")};
    const Surface surface = surface_of(
        grid, [&](Vec3d) { return static_cast<double>(uniform01(address, n++)); }, 0.5);
    return surface;
  };
  const Surface one = surface_on(1);
  expect_closed(one, grid, true);
  for (const int threads : {2, 7}) {
    const Surface many = surface_on(threads);
    EXPECT_EQ(many.triangles, one.triangles) << threads << " threads";
    ASSERT_EQ(many.positions.size(), one.positions.size());
    for (std::size_t i = 0; i < one.positions.size(); ++i)
      ASSERT_TRUE(many.positions[i].x == one.positions[i].x && many.positions[i].y == one.positions[i].y &&
                  many.positions[i].z == one.positions[i].z)
          << "vertex " << i << ", " << threads << " threads";
  }
}

TEST(MarchingCubes, ValuesOnTheLevelStayClosed) {
  const VoxelGrid grid{{0, 0, 0}, 1, 9, 9, 9};
  // Whole numbers, many of them exactly on the level.
  const Surface surface = surface_of(
      grid, [](Vec3d p) { return 3 - std::abs(p.x - 4) - std::abs(p.y - 4) - std::abs(p.z - 4); }, 0);
  EXPECT_EQ(expect_closed(surface, grid, false), 2);
  for (const Vec3d& p : surface.positions)
    EXPECT_NEAR(std::abs(p.x - 4) + std::abs(p.y - 4) + std::abs(p.z - 4), 3, 1e-12);
}

TEST(MarchingCubes, InfiniteDensityIsAWall) {
  const VoxelGrid grid{{0, 0, 0}, 1, 5, 5, 5};
  const Surface surface = surface_of(
      grid, [](Vec3d p) { return p.x > 1.5 ? HUGE_VAL : 0.0; }, 1);
  ASSERT_FALSE(surface.positions.empty());
  for (const Vec3d& p : surface.positions) EXPECT_TRUE(p.x >= 1 && p.x <= 2);
}

TEST(MarchingCubes, RefusesWhatIsNoNumberAndGridsThatAreNone) {
  const VoxelGrid grid{{0, 0, 0}, 0.5, 3, 3, 3};
  const Solid hole = [](Vec3d p) { return p.z > 0.7 && p.x > 0.2 && p.y > 0.7 ? std::nan("") : 0.0; };
  EXPECT_HAS(error_of(ErrorKind::data, [&] { surface_of(grid, hole); }), "(0.500000, 1.000000, 1.000000)");
  EXPECT_THROW(VoxelGrid::covering({}, 0.1), Error);
  for (const double spacing : {0.0, std::nan(""), 1e-5})
    EXPECT_THROW(VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, spacing), Error);
}

TEST(VoxelGrid, CoversTheBoundsWithCubes) {
  const Box box{{-1, 2, 0}, {1, 2.5, 0.9}};
  const VoxelGrid grid = VoxelGrid::covering(box, 2.0 / 64);
  EXPECT_EQ(grid.nx, 65);
  EXPECT_EQ(grid.ny, 17);
  EXPECT_EQ(grid.nz, 30);
  for (int axis = 0; axis < 3; ++axis) {
    const Vec3d last = grid.world(
        {static_cast<double>(grid.nx - 1), static_cast<double>(grid.ny - 1), static_cast<double>(grid.nz - 1)});
    EXPECT_LE(grid.world({0, 0, 0})[axis], box.lo[axis] + 1e-12);
    EXPECT_GE(last[axis], box.hi[axis] - 1e-12);
    EXPECT_LT(last[axis], box.hi[axis] + grid.spacing);
  }
}

TEST(Components, SmallOnesGoAndVerticesAreRenumbered) {
  const VoxelGrid grid = unit_grid(0.05);
  const auto two = [](Vec3d p) {
    return std::max(ball(p), 0.01 - dot(p - Vec3d{0.9, 0.8, 0.8}, p - Vec3d{0.9, 0.8, 0.8}));
  };
  const Surface both = surface_of(grid, two), alone = surface_of(grid, ball);
  const Components parts = components_of(both);
  ASSERT_EQ(parts.faces.size(), 2U);
  EXPECT_EQ(parts.faces[0] + parts.faces[1], static_cast<std::int64_t>(both.triangles.size()));
  Surface cleaned = both;
  EXPECT_EQ(drop_small_components(cleaned, 0.1), 1);
  EXPECT_EQ(cleaned.positions, alone.positions);
  EXPECT_EQ(cleaned.triangles, alone.triangles);
  Surface whole = both;
  EXPECT_EQ(drop_small_components(whole, 0), 2);
  EXPECT_EQ(whole.triangles, both.triangles);
}

// Boxes and spheres with fewer faces, and holes that are closed.

// The level set of a function on a grid over [-1, 1]^3.
Surface level_set(double spacing, const Solid& value) {
  return surface_of(VoxelGrid::covering({{-1, -1, -1}, {1, 1, 1}}, spacing), value);
}
double in_box(Vec3d p) { return 0.713 - std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)}); }

std::size_t border_sides(const Surface& surface) {
  const auto sides = sides_of(surface);
  std::size_t count = 0;
  for (const auto& [side, times] : sides) {
    EXPECT_EQ(times, 1) << "no side has two triangles";
    count += sides.contains({side.second, side.first}) ? 0 : 1;
  }
  return count;
}
std::size_t euler(const Surface& surface) {
  return surface.positions.size() + surface.triangles.size() - sides_of(surface).size() / 2;
}

TEST(Simplify, AClosedBoxStaysClosedAndKeepsItsForm) {
  Surface box = level_set(0.05, in_box);
  const double before = volume(box);
  ASSERT_EQ(border_sides(box), 0U);
  ASSERT_GT(box.triangles.size(), 5000U);
  simplify(box, 200);
  EXPECT_LE(box.triangles.size(), 200U);
  EXPECT_GT(box.triangles.size(), 190U);
  EXPECT_EQ(border_sides(box), 0U);
  EXPECT_EQ(euler(box), 2U) << "one ball, without a handle";
  EXPECT_NEAR(volume(box), before, 0.001 * before) << "flat faces lose nothing";
  EXPECT_EQ(box.normals.size(), box.positions.size());
}

// All of it lies in one plane, so that borders alone have a form.
Surface flat(int side, const std::function<bool(int, int)>& is_there) {
  Surface surface;
  for (int y = 0; y <= side; ++y)
    for (int x = 0; x <= side; ++x) surface.positions.push_back({0.25 * x, 0.25 * y, 0});
  const auto number = [&](int x, int y) { return static_cast<std::uint32_t>((side + 1) * y + x); };
  for (int y = 0; y < side; ++y) {
    for (int x = 0; x < side; ++x) {
      if (!is_there(x, y)) continue;
      surface.triangles.push_back({number(x, y), number(x + 1, y), number(x + 1, y + 1)});
      surface.triangles.push_back({number(x, y), number(x + 1, y + 1), number(x, y + 1)});
    }
  }
  const std::vector<char> all(surface.triangles.size(), 1);
  keep_triangles(surface, all);
  set_vertex_normals(surface);
  return surface;
}
double area(const Surface& surface) {
  double sum = 0;
  for (const Triangle& t : surface.triangles) sum += area_of(surface, t);
  return sum;
}

// A square hole of 4 x 4 quads of side 0.25 in a level square of side 2.
Surface with_hole() {
  return flat(8, [](int x, int y) { return x < 2 || x >= 6 || y < 2 || y >= 6; });
}

TEST(Simplify, BordersStayWhereTheyAre) {
  Surface surface = with_hole();
  ASSERT_EQ(surface.triangles.size(), 96U);
  simplify(surface, 12);
  EXPECT_LE(surface.triangles.size(), 12U);
  EXPECT_NEAR(area(surface), 3, 1e-9) << "the hole and the corners";
  EXPECT_GE(border_sides(surface), 8U);
}

// A ring as thin as it gets: its hole is there still.
TEST(Simplify, ARingStaysARing) {
  Surface ring = level_set(0.1, [](Vec3d p) {
    const double off = std::hypot(p.x, p.y) - 0.6;
    return 0.0625 - off * off - p.z * p.z;
  });
  ASSERT_EQ(euler(ring), 0U);
  simplify(ring, 4);
  EXPECT_EQ(border_sides(ring), 0U);
  EXPECT_EQ(euler(ring), 0U);
  EXPECT_GE(ring.triangles.size(), 14U) << "no ring has fewer faces";
}

TEST(Simplify, LabelsAndColoursStayWithTheirPlaces) {
  Surface square = flat(40, [](int, int) { return true; });  // of side 10
  PointAttributes& known = square.attributes;
  for (const Vec3d& p : square.positions) {
    const bool left = p.x < 4.1;
    known.label.push_back(left ? 3 : 7);
    known.color.push_back({static_cast<std::uint8_t>(left ? 10 : 200), 20, 30});
    known.entropy.push_back(left ? 0.25F : 0.5F);
  }
  simplify(square, 200);
  EXPECT_LE(square.triangles.size(), 200U);
  ASSERT_EQ(known.label.size(), square.positions.size());
  ASSERT_EQ(known.color.size(), square.positions.size());
  ASSERT_EQ(known.entropy.size(), square.positions.size());
  for (std::size_t v = 0; v < known.label.size(); ++v) {
    const bool left = known.label[v] == 3;
    EXPECT_EQ(known.color[v][0], left ? 10 : 200);
    EXPECT_EQ(known.entropy[v], left ? 0.25F : 0.5F);
    EXPECT_TRUE(left ? square.positions[v].x < 4.2 : square.positions[v].x > 4.05) << square.positions[v].x;
  }
  double lefts = 0;
  for (const Triangle& t : square.triangles) lefts += known.label[t[0]] == 3 ? area_of(square, t) : 0;
  EXPECT_NEAR(lefts, 41.25, 1.5) << "half of the column of quads between the classes";
}

// Of vertices that lie at one place one is left.
Surface welded(const Surface& surface) {
  std::map<std::array<double, 3>, std::uint32_t> number;
  std::vector<std::uint32_t> of_vertex;
  Surface out;
  for (const Vec3d& p : surface.positions) {
    const auto [found, fresh] = number.try_emplace({p.x, p.y, p.z}, static_cast<std::uint32_t>(number.size()));
    if (fresh) out.positions.push_back(p);
    of_vertex.push_back(found->second);
  }
  for (const Triangle& t : surface.triangles)
    out.triangles.push_back({of_vertex[t[0]], of_vertex[t[1]], of_vertex[t[2]]});
  return out;
}

// The length of sides that a triangle of the class has alone, but for those on the square's own border.
double border_of_class(const Surface& surface, std::int16_t label, double side) {
  const Surface whole = welded(surface);
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> sides;
  for (std::size_t i = 0; i < whole.triangles.size(); ++i) {
    if (surface.attributes.label[surface.triangles[i][0]] != label) continue;
    const Triangle& t = whole.triangles[i];
    for (std::size_t k = 0; k < 3; ++k) ++sides[std::minmax(t[k], t[(k + 1) % 3])];
  }
  double sum = 0;
  for (const auto& [ends, times] : sides) {
    const Vec3d a = whole.positions[ends.first], b = whole.positions[ends.second];
    const auto outside = [&](int axis) { return a[axis] == b[axis] && (a[axis] == 0 || a[axis] == side); };
    if (times == 1 && !outside(0) && !outside(1)) sum += length(b - a);
  }
  return sum;
}

// A level square of side 10 whose left part is of class 3 and whose top right is of class 5, the rest of class 7.
Surface of_three_classes() {
  Surface square = flat(40, [](int, int) { return true; });
  PointAttributes& known = square.attributes;
  for (const Vec3d& p : square.positions) {
    const bool left = p.x + 0.4 * p.y < 5;
    known.label.push_back(left ? 3 : p.y > 6.1 ? 5 : 7);
    known.color.push_back({static_cast<std::uint8_t>(20 * p.x), 20, 30});
    known.entropy.push_back(0.1F);
  }
  return square;
}

TEST(SmoothBorders, RunAlongTheLineAndNotInSteps) {
  Surface square = of_three_classes();
  const Surface before = square;
  smooth_borders(square);
  const PointAttributes& known = square.attributes;
  ASSERT_EQ(known.label.size(), square.positions.size());
  ASSERT_EQ(known.color.size(), square.positions.size());
  ASSERT_EQ(known.entropy.size(), square.positions.size());
  ASSERT_EQ(square.normals.size(), square.positions.size());
  EXPECT_TRUE(std::equal(before.positions.begin(), before.positions.end(), square.positions.begin()));
  double of_left = 0;
  for (const Triangle& t : square.triangles) {
    EXPECT_EQ(known.label[t[0]], known.label[t[1]]);
    EXPECT_EQ(known.label[t[0]], known.label[t[2]]);
    of_left += known.label[t[0]] == 3 ? area_of(square, t) : 0;
    EXPECT_GT(cross(square.positions[t[1]] - square.positions[t[0]], square.positions[t[2]] - square.positions[t[0]]).z,
              0)
        << "no triangle is turned over";
  }
  EXPECT_NEAR(of_left, 30, 0.3) << "the mean of 5 and 1 times 10";
  for (const std::size_t v : {std::size_t{0}, square.positions.size() - 1})
    EXPECT_NEAR(known.color[v][0], 20 * square.positions[v].x, 1);
  EXPECT_NEAR(area(square), 100, 1e-9);
  EXPECT_NEAR(border_of_class(square, 3, 10), std::hypot(10, 4), 0.2) << "a line, not a staircase";
  Surface whole = welded(square);
  EXPECT_EQ(border_sides(whole), 163U) << "its own four sides alone are open, cut where a border meets them";
}

TEST(SmoothBorders, TheSureOutvoteAndObjectsOfOneClassArePartedToo) {
  Surface square = flat(12, [](int, int) { return true; });
  PointAttributes& known = square.attributes;
  for (const Vec3d& p : square.positions) {
    known.label.push_back(1);
    known.instance.push_back(p.x < 1.4 ? 1 : 2);
    known.color.push_back({});
    known.entropy.push_back(0);
  }
  known.label[6 * 13 + 6] = 2;
  known.entropy[6 * 13 + 6] = 2;
  smooth_borders(square);
  EXPECT_EQ(std::set<std::int16_t>(known.label.begin(), known.label.end()), std::set<std::int16_t>{1});
  double of_first = 0;
  for (const Triangle& t : square.triangles) {
    EXPECT_EQ(known.instance[t[0]], known.instance[t[1]]);
    EXPECT_EQ(known.instance[t[0]], known.instance[t[2]]);
    of_first += known.instance[t[0]] == 1 ? area_of(square, t) : 0;
  }
  EXPECT_NEAR(of_first, 3 * 1.375, 0.15) << "half-way between two columns of vertices";
}

TEST(SmoothBorders, NothingChangesWithoutBordersOrThreads) {
  Surface plain = flat(12, [](int, int) { return true; });
  const Surface before = plain;
  smooth_borders(plain);
  EXPECT_EQ(plain.triangles, before.triangles);
  std::vector<Surface> made;
  for (const int threads : {1, 2}) {
    const ThreadScope scope(threads);
    smooth_borders(made.emplace_back(of_three_classes()));
  }
  EXPECT_EQ(made[0].triangles, made[1].triangles);
  EXPECT_TRUE(made[0].positions == made[1].positions);
}

TEST(CloseHoles, AHoleIsClosedFromTheLengthOfItsBorderOn) {
  Surface surface = with_hole();
  ASSERT_EQ(border_sides(surface), 48U);
  const std::size_t before = surface.triangles.size(), vertices = surface.positions.size();
  EXPECT_EQ(close_holes(surface, 3.99), 0U);
  EXPECT_EQ(surface.triangles.size(), before);
  EXPECT_EQ(close_holes(surface, 4.01), 1U);
  EXPECT_EQ(surface.triangles.size(), before + 14) << "a loop of 16 edges";
  EXPECT_EQ(surface.positions.size(), vertices);
  EXPECT_EQ(border_sides(surface), 32U) << "the outer border";
  EXPECT_NEAR(area(surface), 4, 1e-12);
  for (const Vec3d& n : surface.normals) EXPECT_EQ(n, (Vec3d{0, 0, 1})) << "as the faces around it";
}

TEST(CloseHoles, HolesThatTouchInAVertexAreEachClosed) {
  for (const bool rising : {true, false}) {
    Surface surface = flat(8, [&](int x, int y) { return x != (rising ? y : 7 - y) || x < 2 || x > 4; });
    ASSERT_EQ(border_sides(surface), 44U);
    EXPECT_EQ(close_holes(surface, 1.01), 3U);
    EXPECT_EQ(border_sides(surface), 32U);
    EXPECT_NEAR(area(surface), 4, 1e-12);
  }
}

// Every format read back by a program that shares no code with the writers, and what cameras see of surfaces.

bool python_found() { return std::system("python3 -c 'import json, struct' >/dev/null 2>&1") == 0; }

// Ids over 255, a name of two words, two names that become one, and void with an id of its own.
ClassTable classes() {
  return ClassTable({{7, "void", {0, 0, 0}, true},
                     {3, "wall", {200, 100, 50}, false},
                     {300, "dining table", {10, 20, 30}, false},
                     {65535, "dining_table", {255, 255, 255}, false}});
}

// A ball at coordinates that 32 bits cannot hold, labelled by height.
Surface mesh_files_ball(bool semantics) {
  Surface surface = surface_of(VoxelGrid::covering({{999, -2, 0}, {1001, 0, 2}}, 0.25), [](Vec3d p) {
    const Vec3d off = p - Vec3d{1000, -1, 1};
    return 0.6 - dot(off, off);
  });
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
  std::map<int, nlohmann::json> groups;
  std::map<std::pair<int, int>, nlohmann::json> primitives;  // by object, then by class
  for (const Triangle& t : s.triangles) {
    const int label = s.attributes.has_labels() ? s.attributes.label[t[1]] : -1;
    groups[label]["triangles"].push_back(t);
    const int object = s.attributes.has_instances() ? s.attributes.instance[t[2]] : 0;
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
  Surface surface = mesh_files_ball(semantics);
  smooth_borders(surface);
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

// What cameras see of surfaces whose shape is a formula.

constexpr double kCell = 0.04;

// Where `solid` is positive, in a cube of 3 m.
Surface mesh_files_surface_of(const Solid& solid) {
  return surface_of(VoxelGrid::covering({{-1.5, -1.5, -1.5}, {1.5, 1.5, 1.5}}, kCell), solid);
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
  const Surface all = mesh_files_surface_of(solid), room = mesh_files_surface_of(walls);
  const Surface kept = seen_of(all, around({0.1, -0.2, 0.1}));
  EXPECT_GT(all.triangles.size(), room.triangles.size() + 100);
  EXPECT_EQ(kept.triangles.size(), room.triangles.size());
  for (const Vec3d& p : kept.positions) EXPECT_GT(length(p - hollow), 0.2);
}

// A pillar hides a part of the wall behind it.
TEST(Sights, OneCameraLeavesAShadowThatASecondOneFills) {
  const Vec3d pillar{0.3, 0, 0};
  const auto solid = [&](Vec3d p) { return std::max(walls(p), 0.3 - std::hypot(p.x - pillar.x, p.y - pillar.y)); };
  const Surface all = mesh_files_surface_of(solid);
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

// What stands on a table is seen from all sides but one.
TEST(Sights, AnObjectThatIsSeenButForALittleStaysClosed) {
  const auto solid = [](Vec3d p) { return std::min(ball_value(p, {0, 0, 0}, 1), p.z + 0.85); };
  const Surface all = mesh_files_surface_of(solid);
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

TEST(Surface, SmoothingTakesBumpsOffAndNotTheSize) {
  Surface ball = mesh_files_surface_of([](Vec3d p) { return ball_value(p, {}, 1); });
  const RandomAddress address{3, 0, stream_id("mesh_test/bumps")};
  for (std::size_t v = 0; v < ball.positions.size(); ++v)
    ball.positions[v] = ball.positions[v] * (0.99 + 0.02 * static_cast<double>(uniform01(address, v)));
  const auto mean = [&](double from) {
    double sum = 0;
    for (const Vec3d& p : ball.positions) sum += from == 0 ? length(p) : std::abs(length(p) - from);
    return sum / static_cast<double>(ball.positions.size());
  };
  const double bumps = mean(1);
  smooth(ball, 10);
  EXPECT_LT(mean(1), 0.5 * bumps);
  EXPECT_NEAR(mean(0), 1, 0.002);
}

// A red pillar before walls of a colour of the place, photographed by cameras that are a pixel and a half off: one
// photograph is burnt, and in one a stranger, who is masked, hides the wall.
TEST(Sights, PhotographsColourWhatTheyShow) {
  const auto pillar = [](Vec3d p) { return 0.3 - std::hypot(p.x - 0.3, p.y); };
  const auto solid = [&](Vec3d p) { return std::max(walls(p), pillar(p)); };
  const auto color_of = [&](Vec3d p) -> std::array<std::uint8_t, 3> {
    if (pillar(p) > -0.02) return {200, 0, 0};
    return {static_cast<std::uint8_t>(100 + 50 * p.z), 150, static_cast<std::uint8_t>(100 + 50 * p.y)};
  };
  std::vector<RayCamera> cameras;
  for (const double y : {-0.8, -0.5, -0.2, 0.2, 0.5, 0.8}) cameras.push_back(camera_at({-0.9, y, 0.1 * y}, {1, 0, 0}));
  std::vector<StoredFrame> frames(cameras.size());
  PhotoColors colors;
  for (std::size_t f = 0; f < frames.size(); ++f) {
    StoredFrame& frame = frames[f];
    const RayCamera& camera = cameras[f];
    frame.width_px = camera.camera.width_px;
    frame.height_px = camera.camera.height_px;
    std::vector<std::uint8_t> used;
    for (int i = 0; i < frame.width_px * frame.height_px; ++i) {
      const double u = i % frame.width_px + (f % 2 == 0 ? 2 : -1), v = i / frame.width_px + 0.5;
      const Vec3d ray = camera.world_from_camera.rotate(camera.camera.direction(u, v));
      Vec3d p = camera.world_from_camera.t;
      while (solid(p) < 0) p = p + ray * 0.01;
      const bool stranger = f == 2 && u < 60;
      for (const std::uint8_t c : color_of(p)) frame.rgb.push_back(f == 0 || stranger ? 255 : c);
      used.push_back(stranger ? 0 : 1);
    }
    frame.mask = PixelMask(used);
    colors.photos.push_back(&frame);
  }
  const Surface all = mesh_files_surface_of(solid);
  const std::vector<Sights> sights = sights_of(all, cameras, limits(), kCell, &colors);
  std::int64_t seen = 0, wrong = 0, black = 0;
  for (std::size_t v = 0; v < sights.size(); ++v) {
    black += colors.color[v] == std::array<std::uint8_t, 3>{} ? 1 : 0;
    if (sights[v].camera[2] < 0) continue;
    ++seen;
    for (std::size_t c = 0; c < 3; ++c) {
      if (std::abs(colors.color[v][c] - color_of(all.positions[v])[c]) <= 20) continue;
      ++wrong;
      break;
    }
  }
  ASSERT_GT(seen, 3000);
  EXPECT_LT(wrong, seen / 20);
  EXPECT_EQ(black, 0) << "what none shows has a colour of what is around it";
}

TEST(Sights, FollowTheLensAndTheLimitsAndNotTheThreads) {
  const Surface all = mesh_files_surface_of([](Vec3d p) { return std::max(walls(p), ball_value(p, {0, 0, 0}, 0.3)); });
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

// The page of a surface as text: what stands in it, whatever the names in the scene are.

using namespace app;

std::string element(const std::string& page, const std::string& open) {
  const std::size_t begin = page.find(open);
  if (begin == std::string::npos) return {};
  const std::size_t from = begin + open.size();
  return page.substr(from, page.find("</", from) - from);
}

// Names are those of the places that the page's parts are filled into.
TEST(ScenePage, NamesOfAnySceneStayNames) {
  const std::vector<std::string> names{"/*mesh*/", "/*facts*/", "/*script*/", "<!--title-->", "</script>", "/*style*/"};
  std::vector<ClassEntry> entries;
  for (const std::string& name : names)
    entries.push_back({static_cast<std::int32_t>(entries.size()) + 1, name, {}, false});
  Surface surface;
  surface.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  surface.triangles = {{0, 1, 2}};
  surface.attributes.color.assign(3, {1, 2, 3});
  surface.attributes.label.assign(3, 0);
  surface.attributes.entropy.assign(3, 0);
  ScenePage page;
  page.title = "/*mesh*/ <!--connect-->";
  page.about = {"/*mesh*/"};
  page.run = "/*style*/";
  page.labels = true;
  const std::string text = scene_page_text(surface, ClassTable(entries), page);
  const nlohmann::json facts =
      nlohmann::json::parse(element(text, "<script type=\"application/json\" id=\"facts\">"), nullptr, false);
  ASSERT_TRUE(facts.is_object());
  ASSERT_EQ(facts.at("classes").size(), names.size());
  for (std::size_t i = 0; i < names.size(); ++i) EXPECT_EQ(facts.at("classes")[i].at("name"), names[i]);
  EXPECT_EQ(facts.at("title"), page.title);
  EXPECT_EQ(facts.at("run"), page.run);
  const std::string mesh = element(text, "<script type=\"text/plain\" id=\"mesh\">");
  EXPECT_FALSE(mesh.empty());
  EXPECT_EQ(mesh.find('*'), std::string::npos) << "the mesh is where it belongs";
  EXPECT_EQ(element(text, "<title>"), "/*mesh*/ &lt;!--connect--&gt;");
  EXPECT_HAS(text, "connect-src 'none'");
}

}  // namespace
}  // namespace semfield
