#include "surface/mesh/marching_cubes.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"

namespace semfield {

namespace {

constexpr double kMostPoints = 4096;  // along an axis: layers then take 640 MiB
constexpr std::uint32_t kNoVertex = 0xFFFFFFFFU;

// Vertices on the edges of a layer that run along x and y, and on those that rise from it along z.
struct LayerEdges {
  explicit LayerEdges(std::int64_t points) {
    for (auto& axis : vertex) axis.assign(static_cast<std::size_t>(points), kNoVertex);
  }
  std::array<std::vector<std::uint32_t>, 3> vertex;
};

// Rows of a layer that a thread takes, and what it finds there: the vertices of a layer are numbered in the order of
// its points, whoever found them.
struct Strip {
  std::int64_t first_row = 0, end_row = 0;
  std::vector<Vec3d> level, rising;  // vertices on edges in the upper layer, and on those that rise to it
  std::vector<std::array<std::uint32_t, 3>> triangles;
  std::size_t first_level = 0, first_rising = 0;  // their numbers
  bool all_numbers = true;
};

class Marcher {
 public:
  Marcher(const VoxelGrid& grid, double level) : grid_(grid), level_(level) {
    constexpr std::int64_t kStripPoints = 4096;
    const std::int64_t rows = std::max<std::int64_t>(1, kStripPoints / grid.nx);
    for (std::int64_t row = 0; row < grid.ny; row += rows) {
      strips_.emplace_back();
      strips_.back().first_row = row;
      strips_.back().end_row = std::min(row + rows, grid.ny);
    }
  }

  Surface run(const GridLayer& layer) {
    const std::int64_t points = grid_.layer_points();
    std::vector<double> below(static_cast<std::size_t>(points)), above(below.size());
    LayerEdges lower(points), upper(points);
    for (std::int64_t z = 0; z < grid_.nz; ++z) {
      layer(z, above);
      for_strips([&](Strip& strip) {
        level_edges(strip, above, z, upper);
        if (z > 0) rising_edges(strip, below, above, z - 1, lower);
      });
      check(above, z);
      number_vertices();
      for_strips([&](const Strip& strip) { keep_vertices(strip, lower, upper); });
      if (z > 0) {
        for_strips([&](Strip& strip) { cells(strip, below, above, lower, upper); });
        for (const Strip& strip : strips_)
          surface_.triangles.insert(surface_.triangles.end(), strip.triangles.begin(), strip.triangles.end());
      }
      std::swap(below, above);
      std::swap(lower, upper);
    }
    return std::move(surface_);
  }

 private:
  bool dense(double value) const { return value > level_; }

  template <class Body>
  void for_strips(const Body& body) {
    parallel_for(std::ssize(strips_), [&](std::int64_t i) { body(strips_[static_cast<std::size_t>(i)]); });
  }

  void check(const std::vector<double>& values, std::int64_t z) const {
    if (std::all_of(strips_.begin(), strips_.end(), [](const Strip& strip) { return strip.all_numbers; })) return;
    const auto bad = std::find_if(values.begin(), values.end(), [](double value) { return std::isnan(value); });
    const std::int64_t at = bad - values.begin();
    const Vec3d p =
        grid_.world({static_cast<double>(at % grid_.nx), static_cast<double>(at / grid_.nx), static_cast<double>(z)});
    throw Error(ErrorKind::data, "mesh.density.not_finite",
                "the density at (" + std::to_string(p.x) + ", " + std::to_string(p.y) + ", " + std::to_string(p.z) +
                    ") is not a number",
                "train again, or use an earlier checkpoint");
  }

  // Number in `vertices` of the one on the edge from `at` along `axis`.
  std::uint32_t cross_edge(double a, double b, Vec3d at, int axis, std::vector<Vec3d>& vertices) const {
    if (dense(a) == dense(b)) return kNoVertex;
    // Both infinite, or one: halfway and the far end are what interpolation tends to.
    double share = (level_ - a) / (b - a);
    if (std::isnan(share)) share = 0.5;
    at[axis] += std::clamp(share, 0.0, 1.0);
    vertices.push_back(grid_.world(at));
    return static_cast<std::uint32_t>(vertices.size() - 1);
  }

  template <class Body>
  void each_point(const Strip& strip, Body body) const {
    auto i = static_cast<std::size_t>(strip.first_row * grid_.nx);
    for (std::int64_t y = strip.first_row; y < strip.end_row; ++y) {
      for (std::int64_t x = 0; x < grid_.nx; ++x, ++i) body(i, x, y);
    }
  }

  void level_edges(Strip& strip, const std::vector<double>& values, std::int64_t z, LayerEdges& edges) const {
    const auto row = static_cast<std::size_t>(grid_.nx);
    strip.level.clear();
    strip.rising.clear();
    strip.all_numbers = true;
    each_point(strip, [&](std::size_t i, std::int64_t x, std::int64_t y) {
      const Vec3d at{static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)};
      if (std::isnan(values[i])) strip.all_numbers = false;
      edges.vertex[0][i] = x + 1 < grid_.nx ? cross_edge(values[i], values[i + 1], at, 0, strip.level) : kNoVertex;
      edges.vertex[1][i] = y + 1 < grid_.ny ? cross_edge(values[i], values[i + row], at, 1, strip.level) : kNoVertex;
    });
  }

  void rising_edges(Strip& strip, const std::vector<double>& below, const std::vector<double>& above, std::int64_t z,
                    LayerEdges& edges) const {
    each_point(strip, [&](std::size_t i, std::int64_t x, std::int64_t y) {
      const Vec3d at{static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)};
      edges.vertex[2][i] = cross_edge(below[i], above[i], at, 2, strip.rising);
    });
  }

  void number_vertices() {
    std::size_t next = surface_.positions.size();
    for (Strip& strip : strips_) {
      strip.first_level = next;
      next += strip.level.size();
    }
    for (Strip& strip : strips_) {
      strip.first_rising = next;
      next += strip.rising.size();
    }
    if (next >= kNoVertex) {
      throw Error(ErrorKind::data, "mesh.surface.size", "the surface has more vertices than 32 bits can number",
                  "choose a larger --voxel");
    }
    surface_.positions.resize(next);
  }

  void keep_vertices(const Strip& strip, LayerEdges& lower, LayerEdges& upper) {
    std::copy(strip.level.begin(), strip.level.end(), surface_.positions.data() + strip.first_level);
    std::copy(strip.rising.begin(), strip.rising.end(), surface_.positions.data() + strip.first_rising);
    const auto begin = static_cast<std::size_t>(strip.first_row * grid_.nx);
    const auto end = static_cast<std::size_t>(strip.end_row * grid_.nx);
    const auto number = [&](std::vector<std::uint32_t>& vertices, std::size_t first) {
      for (std::size_t i = begin; i < end; ++i) {
        if (vertices[i] != kNoVertex) vertices[i] += static_cast<std::uint32_t>(first);
      }
    };
    number(upper.vertex[0], strip.first_level);
    number(upper.vertex[1], strip.first_level);
    if (!strip.rising.empty()) number(lower.vertex[2], strip.first_rising);
  }

  void cells(Strip& strip, const std::vector<double>& below, const std::vector<double>& above, const LayerEdges& lower,
             const LayerEdges& upper) const {
    const std::vector<CubeCase>& cases = cube_cases();
    const auto row = static_cast<std::size_t>(grid_.nx);
    strip.triangles.clear();
    each_point(strip, [&](std::size_t i, std::int64_t x, std::int64_t y) {
      if (x + 1 >= grid_.nx || y + 1 >= grid_.ny) return;
      const std::array<double, 8> corner{below[i], below[i + 1], below[i + row], below[i + row + 1],
                                         above[i], above[i + 1], above[i + row], above[i + row + 1]};
      unsigned pattern = 0;
      for (unsigned c = 0; c < 8; ++c) pattern |= dense(corner[c]) ? 1U << c : 0U;
      if (pattern == 0 || pattern == 255) return;
      const auto vertex = [&](unsigned edge) {
        const unsigned u = edge & 1, v = edge >> 1 & 1;
        switch (edge / 4) {
          case 0:
            return (v != 0 ? upper : lower).vertex[0][i + u * row];  // u along y, v along z
          case 1:
            return (u != 0 ? upper : lower).vertex[1][i + v];  // u along z, v along x
          default:
            return lower.vertex[2][i + u + v * row];  // u along x, v along y
        }
      };
      for (const auto& t : cases[pattern].triangles)
        strip.triangles.push_back({vertex(t[0]), vertex(t[1]), vertex(t[2])});
    });
  }

  const VoxelGrid& grid_;
  double level_;
  std::vector<Strip> strips_;
  Surface surface_;
};

}  // namespace

VoxelGrid VoxelGrid::covering(const Box& bounds, double spacing) {
  if (bounds.empty())
    throw Error(ErrorKind::usage, "mesh.bounds.empty", "the scene's bounds are empty", "set scene.load.bounds");
  if (!(spacing > 0) || !std::isfinite(spacing))
    throw Error(ErrorKind::usage, "mesh.voxel.size", "a voxel of " + std::to_string(spacing),
                "give a positive edge length");
  VoxelGrid grid;
  grid.spacing = spacing;
  const Vec3d size = bounds.size();
  std::int64_t* const counts[3] = {&grid.nx, &grid.ny, &grid.nz};
  for (int axis = 0; axis < 3; ++axis) {
    // The slack absorbs rounding when the spacing is a fraction of the side itself.
    const double cells = std::max(1.0, std::ceil(size[axis] / spacing - 1e-9));
    if (!(cells < kMostPoints)) {
      throw Error(ErrorKind::usage, "mesh.voxel.count",
                  "voxels of " + std::to_string(spacing) + " would be more than 4095 along an axis",
                  "choose a larger --voxel or a smaller --resolution");
    }
    *counts[axis] = static_cast<std::int64_t>(cells) + 1;
    grid.origin[axis] = bounds.center()[axis] - 0.5 * cells * spacing;
  }
  return grid;
}

Surface marching_cubes(const VoxelGrid& grid, double level, const GridLayer& layer) {
  return Marcher(grid, level).run(layer);
}

// The case table of marching cubes, derived from one rule for a face.

namespace {

using Loop = std::vector<int>;  // numbers of cube edges, in order

int corner_at(int axis, int side, int u, int v) { return side << axis | u << (axis + 1) % 3 | v << (axis + 2) % 3; }

// The edge between two neighbouring corners.
int edge_between(int a, int b) {
  const int along = a ^ b;
  const int axis = along == 1 ? 0 : along == 2 ? 1 : 2;
  return 4 * axis + ((a >> (axis + 1) % 3) & 1) + 2 * ((a >> (axis + 2) % 3) & 1);
}

// Corners of a face, counter-clockwise seen from outside the cube.
std::array<int, 4> face_cycle(int axis, int side) {
  std::array<int, 4> cycle{corner_at(axis, side, 0, 0), corner_at(axis, side, 1, 0), corner_at(axis, side, 1, 1),
                           corner_at(axis, side, 0, 1)};
  if (side == 0) std::swap(cycle[1], cycle[3]);
  return cycle;
}

bool on_one_face(int edge_a, int edge_b) {
  const auto faces = [](int edge) {
    const int axis = edge / 4, u = edge & 1, v = edge >> 1 & 1;
    return std::array<int, 2>{2 * ((axis + 1) % 3) + u, 2 * ((axis + 2) % 3) + v};
  };
  for (const int a : faces(edge_a)) {
    for (const int b : faces(edge_b)) {
      if (a == b) return true;
    }
  }
  return false;
}

// Around every run of dense corners of a face goes one segment, from where the face's cycle leaves the run to where it
// entered it. An edge that is left on one face is entered on the other, so segments chain into loops.
std::vector<Loop> loops_of(int pattern) {
  std::array<int, 12> next;
  next.fill(-1);
  for (int face = 0; face < 6; ++face) {
    const std::array<int, 4> cycle = face_cycle(face / 2, face % 2);
    const auto dense = [&](int i) { return (pattern >> cycle[static_cast<std::size_t>(i & 3)] & 1) != 0; };
    const auto edge = [&](int i) {
      return edge_between(cycle[static_cast<std::size_t>(i & 3)], cycle[static_cast<std::size_t>((i + 1) & 3)]);
    };
    for (int i = 0; i < 4; ++i) {
      if (!dense(i) || dense(i + 1)) continue;
      int begin = i;
      while (dense(begin + 3)) begin += 3;  // one corner back
      next[static_cast<std::size_t>(edge(i))] = edge(begin + 3);
    }
  }
  std::vector<Loop> loops;
  std::array<bool, 12> seen{};
  for (int start = 0; start < 12; ++start) {
    if (next[static_cast<std::size_t>(start)] < 0 || seen[static_cast<std::size_t>(start)]) continue;
    Loop loop;
    for (int e = start; !seen[static_cast<std::size_t>(e)]; e = next[static_cast<std::size_t>(e)]) {
      seen[static_cast<std::size_t>(e)] = true;
      loop.push_back(e);
    }
    loops.push_back(std::move(loop));
  }
  return loops;
}

using Triangles = std::vector<std::array<std::uint8_t, 3>>;

// Triangles of loop[begin..end] (closed by the side end -> begin) without a diagonal in a face of the cube: there the
// neighbouring cube could have the same one, and the edge would have four triangles.
std::optional<Triangles> triangulate(const Loop& loop, std::size_t begin, std::size_t end) {
  if (end - begin < 2) return Triangles{};
  const auto allowed = [&](std::size_t a, std::size_t b) { return b - a == 1 || !on_one_face(loop[a], loop[b]); };
  for (std::size_t middle = begin + 1; middle < end; ++middle) {
    if (!allowed(begin, middle) || !allowed(middle, end)) continue;
    std::optional<Triangles> left = triangulate(loop, begin, middle);
    if (!left) continue;
    const std::optional<Triangles> right = triangulate(loop, middle, end);
    if (!right) continue;
    left->insert(left->end(), right->begin(), right->end());
    // The loop turns clockwise seen from the empty side.
    left->push_back({static_cast<std::uint8_t>(loop[end]), static_cast<std::uint8_t>(loop[middle]),
                     static_cast<std::uint8_t>(loop[begin])});
    return left;
  }
  return std::nullopt;
}

}  // namespace

const std::vector<CubeCase>& cube_cases() {
  static const std::vector<CubeCase> table = [] {
    std::vector<CubeCase> cases(256);
    for (int pattern = 0; pattern < 256; ++pattern) {
      for (const Loop& loop : loops_of(pattern)) {
        const std::optional<Triangles> triangles = triangulate(loop, 0, loop.size() - 1);
        SEMFIELD_CHECK(triangles, "every loop has triangles that keep off the cube's faces");
        auto& all = cases[static_cast<std::size_t>(pattern)].triangles;
        all.insert(all.end(), triangles->begin(), triangles->end());
      }
    }
    return cases;
  }();
  return table;
}

}  // namespace semfield
