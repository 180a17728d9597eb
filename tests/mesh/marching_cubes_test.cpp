// Surfaces of known solids: closed, oriented, accurate to second order; every sign pattern, random ones too.
#include "surface/mesh/marching_cubes.h"

#include <algorithm>
#include <map>
#include <set>

#include "compute/parallel.h"
#include "core/error.h"
#include "core/rng.h"
#include "tests/says.h"

namespace semfield {
namespace {

using Solid = std::function<double(Vec3d)>;

Surface surface_of(const VoxelGrid& grid, const Solid& solid, double level = 0) {
  return marching_cubes(grid, level, [&](std::int64_t z, std::span<double> values) {
    ASSERT_EQ(static_cast<std::int64_t>(values.size()), grid.layer_points());
    for (std::int64_t i = 0; i < grid.layer_points(); ++i)
      values[i] = solid(
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}));
  });
}

bool on_border(const VoxelGrid& grid, Vec3d p) {
  const std::int64_t last[3] = {grid.nx - 1, grid.ny - 1, grid.nz - 1};
  for (int axis = 0; axis < 3; ++axis) {
    const double index = (p[axis] - grid.origin[axis]) / grid.spacing;
    if (index < 1e-9 || index > static_cast<double>(last[axis]) - 1e-9) return true;
  }
  return false;
}

// Every edge: once in each direction, or on the border of the grid. Returns V - E + F.
std::int64_t expect_closed(const Surface& surface, const VoxelGrid& grid, bool border_allowed) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> directed;
  std::set<std::uint32_t> used;
  for (const Triangle& t : surface.triangles) {
    for (int i = 0; i < 3; ++i) {
      const std::uint32_t a = t[i], b = t[(i + 1) % 3];
      EXPECT_NE(a, b);
      ++directed[{a, b}];
      used.insert(a);
    }
  }
  EXPECT_EQ(used.size(), surface.positions.size()) << "a vertex without a triangle";
  std::int64_t edges = 0, open = 0;
  for (const auto& [edge, count] : directed) {
    EXPECT_EQ(count, 1) << "two triangles run along an edge in the same direction";
    const bool both = directed.count({edge.second, edge.first}) != 0;
    edges += both && edge.first > edge.second ? 0 : 1;
    if (both) continue;
    ++open;
    EXPECT_TRUE(border_allowed && on_border(grid, surface.positions[edge.first]) &&
                on_border(grid, surface.positions[edge.second]))
        << "a crack inside the grid";
  }
  EXPECT_TRUE(border_allowed || open == 0) << open;
  return static_cast<std::int64_t>(surface.positions.size()) - edges +
         static_cast<std::int64_t>(surface.triangles.size());
}

VoxelGrid unit_grid(double spacing) { return VoxelGrid::covering({{-1, -1.2, -0.9}, {1.1, 1, 1}}, spacing); }

const Vec3d kCenter{0.03, -0.11, 0.07};
constexpr double kRadius = 0.61;
double ball(Vec3d p) { return kRadius * kRadius - dot(p - kCenter, p - kCenter); }
double ring(Vec3d p) {
  const double around = std::hypot(p.x, p.y) - 0.55;
  return 0.2 * 0.2 - around * around - p.z * p.z;
}

struct SphereErrors {
  double radius = 0, normal = 0, volume = 0;
};

SphereErrors sphere_errors(double spacing) {
  const VoxelGrid grid = unit_grid(spacing);
  Surface surface = surface_of(grid, ball);
  EXPECT_EQ(expect_closed(surface, grid, false), 2);
  set_vertex_normals(surface);
  SphereErrors errors;
  for (std::size_t v = 0; v < surface.positions.size(); ++v) {
    const Vec3d out = surface.positions[v] - kCenter;
    errors.radius = std::max(errors.radius, std::abs(length(out) - kRadius));
    errors.normal = std::max(errors.normal, length(surface.normals[v] - normalized(out)));
  }
  double volume = 0;
  for (const Triangle& t : surface.triangles)
    volume += dot(surface.positions[t[0]], cross(surface.positions[t[1]], surface.positions[t[2]])) / 6;
  errors.volume = std::abs(volume - 4.0 / 3 * 3.141592653589793 * kRadius * kRadius * kRadius);
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

TEST(MarchingCubes, TorusIsClosedAndHasAHole) {
  const VoxelGrid grid = unit_grid(0.04);
  EXPECT_EQ(expect_closed(surface_of(grid, ring), grid, false), 0);
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

TEST(MarchingCubes, RandomFieldsAreClosed) {
  // Half of the points dense at random: every ambiguous pair of cubes occurs many times.
  for (std::uint64_t seed = 1; seed <= 6; ++seed) {
    const VoxelGrid grid{{-3, 5, 0.5}, 0.25, 19, 17, 21};
    std::uint64_t n = 0;
    const RandomAddress address{seed, 0, stream_id("mesh_test/field")};
    const Surface surface = surface_of(
        grid, [&](Vec3d) { return static_cast<double>(uniform01(address, n++)); }, 0.5);
    EXPECT_GT(surface.triangles.size(), 10000U);
    expect_closed(surface, grid, true);
  }
}

TEST(MarchingCubes, ThreadsChangeNeitherVerticesNorTriangles) {
  const VoxelGrid grid{{-3, 5, 0.5}, 0.25, 130, 111, 5};  // layers of several strips
  const auto surface_on = [&](int threads) {
    set_thread_count(threads);
    std::uint64_t n = 0;
    const RandomAddress address{7, 0, stream_id("mesh_test/field")};
    const Surface surface = surface_of(
        grid, [&](Vec3d) { return static_cast<double>(uniform01(address, n++)); }, 0.5);
    set_thread_count(0);
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
  EXPECT_HAS(
      error_of(
          ErrorKind::data,
          [&] { surface_of(grid, [](Vec3d p) { return p.z > 0.7 && p.x > 0.2 && p.y > 0.7 ? std::nan("") : 0.0; }); }),
      "(0.500000, 1.000000, 1.000000)");
  EXPECT_THROW(VoxelGrid::covering({}, 0.1), Error);
  EXPECT_THROW(VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, 0), Error);
  EXPECT_THROW(VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, std::nan("")), Error);
  EXPECT_THROW(VoxelGrid::covering({{0, 0, 0}, {1, 1, 1}}, 1e-5), Error);
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

}  // namespace
}  // namespace semfield
