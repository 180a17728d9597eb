// Boxes and spheres with fewer faces, and holes that are closed.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>

#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/shape/simplify.h"

namespace semfield {
namespace {

// The level set of a function on a grid over [-1, 1]^3.
template <class Value>
Surface level_set(double spacing, const Value& value) {
  const VoxelGrid grid = VoxelGrid::covering({{-1, -1, -1}, {1, 1, 1}}, spacing);
  Surface surface = marching_cubes(grid, 0, [&](std::int64_t z, std::span<double> values) {
    for (std::int64_t i = 0; i < grid.layer_points(); ++i)
      values[static_cast<std::size_t>(i)] = value(
          grid.world({static_cast<double>(i % grid.nx), static_cast<double>(i / grid.nx), static_cast<double>(z)}));
  });
  set_vertex_normals(surface);
  return surface;
}
double in_box(Vec3d p) { return 0.713 - std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)}); }
double in_ball(Vec3d p) { return 0.8 - length(p); }

// Of each pair of vertices, how often one triangle runs from the first to the second.
std::map<std::pair<std::uint32_t, std::uint32_t>, int> sides_of(const Surface& surface) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> sides;
  for (const Triangle& t : surface.triangles)
    for (std::size_t k = 0; k < 3; ++k) ++sides[{t[k], t[(k + 1) % 3]}];
  return sides;
}
std::size_t border_sides(const Surface& surface) {
  const auto sides = sides_of(surface);
  std::size_t count = 0;
  for (const auto& [side, times] : sides) {
    EXPECT_EQ(times, 1) << "no side has two triangles";
    count += sides.contains({side.second, side.first}) ? 0 : 1;
  }
  return count;
}
double volume(const Surface& surface) {
  double sum = 0;
  for (const Triangle& t : surface.triangles)
    sum += dot(surface.positions[t[0]], cross(surface.positions[t[1]], surface.positions[t[2]])) / 6;
  return sum;
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

TEST(Simplify, ABallKeepsItsRadius) {
  Surface ball = level_set(0.05, in_ball);
  for (const Vec3d& p : ball.positions)  // a colour that tells the place
    ball.attributes.color.push_back({static_cast<std::uint8_t>(100 + 100 * p.x),
                                     static_cast<std::uint8_t>(100 + 100 * p.y),
                                     static_cast<std::uint8_t>(100 + 100 * p.z)});
  simplify(ball, 500);
  double off = 0;
  for (std::size_t v = 0; v < ball.positions.size(); ++v) {
    const auto& c = ball.attributes.color[v];
    off += length(Vec3d{c[0] / 100.0 - 1, c[1] / 100.0 - 1, c[2] / 100.0 - 1} - ball.positions[v]);
  }
  EXPECT_LT(off / static_cast<double>(ball.positions.size()), 0.08) << "of the nearer end; of any it is 0.095";
  EXPECT_LE(ball.triangles.size(), 500U);
  EXPECT_EQ(border_sides(ball), 0U);
  for (const Vec3d& p : ball.positions) EXPECT_NEAR(length(p), 0.8, 0.02);
  for (std::size_t v = 0; v < ball.positions.size(); ++v) EXPECT_GT(dot(ball.normals[v], ball.positions[v]), 0.7);
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
    known.color.push_back(left ? std::array<std::uint8_t, 3>{10, 20, 30} : std::array<std::uint8_t, 3>{200, 0, 0});
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
  for (const Triangle& t : square.triangles) lefts += triangle_label(known, t) == 3 ? area_of(square, t) : 0;
  EXPECT_NEAR(lefts, 41.25, 1.5) << "half of the column of quads between the classes";
}

TEST(Simplify, TheResultIsTheSameEachTimeAndEnoughIsLeftAlone) {
  Surface one = level_set(0.1, in_ball), two = level_set(0.1, in_ball);
  const Surface whole = one;
  simplify(one, whole.triangles.size());
  EXPECT_EQ(one.positions, whole.positions);
  simplify(one, 100);
  simplify(two, 100);
  EXPECT_EQ(one.positions, two.positions);
  EXPECT_EQ(one.triangles, two.triangles);
  Surface least = level_set(0.2, in_ball);
  simplify(least, 1);
  EXPECT_EQ(border_sides(least), 0U) << "a budget that cannot be met leaves a closed surface";
  EXPECT_GE(least.triangles.size(), 4U);
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

}  // namespace
}  // namespace semfield
