#include "mesh/marching_cubes.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/error.h"

namespace semfield {

namespace {

constexpr double kMostPoints = 4096;  // along an axis: layers then take 640 MiB
constexpr std::uint32_t kNone = 0xFFFFFFFFU;

// Vertices on the edges of a layer that run along x and y, and on those that rise from it along z.
struct LayerEdges {
  explicit LayerEdges(std::int64_t points) {
    for (auto& axis : vertex) axis.assign(static_cast<std::size_t>(points), kNone);
  }
  std::array<std::vector<std::uint32_t>, 3> vertex;
};

class Marcher {
 public:
  Marcher(const VoxelGrid& grid, double level) : grid_(grid), level_(level) {}

  Surface run(const GridLayer& layer) {
    const std::int64_t points = grid_.layer_points();
    std::vector<double> below(static_cast<std::size_t>(points)), above(below.size());
    LayerEdges lower(points), upper(points);
    for (std::int64_t z = 0; z < grid_.nz; ++z) {
      layer(z, above);
      check(above, z);
      level_edges(above, z, upper);
      if (z > 0) {
        rising_edges(below, above, z - 1, lower);
        cells(below, above, lower, upper);
      }
      std::swap(below, above);
      std::swap(lower, upper);
    }
    return std::move(surface_);
  }

 private:
  bool dense(double value) const { return value > level_; }

  void check(const std::vector<double>& values, std::int64_t z) const {
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (!std::isnan(values[i])) continue;
      const auto at = static_cast<std::int64_t>(i);
      const Vec3d p =
          grid_.world({static_cast<double>(at % grid_.nx), static_cast<double>(at / grid_.nx), static_cast<double>(z)});
      throw Error(ErrorKind::data,
                  "the density at (" + std::to_string(p.x) + ", " + std::to_string(p.y) + ", " + std::to_string(p.z) +
                      ") is not a number",
                  "train again, or use an earlier checkpoint");
    }
  }

  std::uint32_t cross_edge(double a, double b, Vec3d at, int axis) {
    if (dense(a) == dense(b)) return kNone;
    // Both infinite, or one: halfway and the far end are what interpolation tends to.
    double share = (level_ - a) / (b - a);
    if (std::isnan(share)) share = 0.5;
    at[axis] += std::clamp(share, 0.0, 1.0);
    if (surface_.positions.size() >= kNone - 1) {
      throw Error(ErrorKind::data, "the surface has more vertices than 32 bits can number", "choose a larger --voxel");
    }
    surface_.positions.push_back(grid_.world(at));
    return static_cast<std::uint32_t>(surface_.positions.size() - 1);
  }

  template <class Body>
  void each_point(Body body) const {
    std::size_t i = 0;
    for (std::int64_t y = 0; y < grid_.ny; ++y) {
      for (std::int64_t x = 0; x < grid_.nx; ++x, ++i) body(i, x, y);
    }
  }

  void level_edges(const std::vector<double>& values, std::int64_t z, LayerEdges& edges) {
    const auto row = static_cast<std::size_t>(grid_.nx);
    each_point([&](std::size_t i, std::int64_t x, std::int64_t y) {
      const Vec3d at{static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)};
      edges.vertex[0][i] = x + 1 < grid_.nx ? cross_edge(values[i], values[i + 1], at, 0) : kNone;
      edges.vertex[1][i] = y + 1 < grid_.ny ? cross_edge(values[i], values[i + row], at, 1) : kNone;
    });
  }

  void rising_edges(const std::vector<double>& below, const std::vector<double>& above, std::int64_t z,
                    LayerEdges& edges) {
    each_point([&](std::size_t i, std::int64_t x, std::int64_t y) {
      edges.vertex[2][i] =
          cross_edge(below[i], above[i], {static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)}, 2);
    });
  }

  void cells(const std::vector<double>& below, const std::vector<double>& above, const LayerEdges& lower,
             const LayerEdges& upper) {
    const std::vector<CubeCase>& cases = cube_cases();
    const auto row = static_cast<std::size_t>(grid_.nx);
    each_point([&](std::size_t i, std::int64_t x, std::int64_t y) {
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
      for (const auto& t : cases[pattern].triangles) {
        surface_.triangles.push_back({vertex(t[0]), vertex(t[1]), vertex(t[2])});
      }
    });
  }

  const VoxelGrid& grid_;
  double level_;
  Surface surface_;
};

}  // namespace

VoxelGrid VoxelGrid::covering(const Box& bounds, double spacing) {
  if (bounds.empty()) throw Error(ErrorKind::usage, "the scene's bounds are empty", "set scene.load.bounds");
  if (!(spacing > 0) || !std::isfinite(spacing))
    throw Error(ErrorKind::usage, "a voxel of " + std::to_string(spacing), "give a positive edge length");
  VoxelGrid grid;
  grid.spacing = spacing;
  const Vec3d size = bounds.size();
  std::int64_t* const counts[3] = {&grid.nx, &grid.ny, &grid.nz};
  for (int axis = 0; axis < 3; ++axis) {
    // The slack absorbs rounding when the spacing is a fraction of the side itself.
    const double cells = std::max(1.0, std::ceil(size[axis] / spacing - 1e-9));
    if (!(cells < kMostPoints)) {
      throw Error(ErrorKind::usage, "voxels of " + std::to_string(spacing) + " would be more than 4095 along an axis",
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

}  // namespace semfield
