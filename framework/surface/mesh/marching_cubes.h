// Marching cubes [Lorensen87] over a grid that is read layer by layer; the case table is derived, not typed in.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "surface/mesh/surface.h"

namespace semfield {

/// Points at the corners of cubes. `world` is the one transform from the grid to the world: nothing else in this folder
/// moves a point.
struct VoxelGrid {
  Vec3d origin;                         ///< of point (0, 0, 0), world units
  double spacing = 1;                   ///< edge of a cell, world units
  std::int64_t nx = 0, ny = 0, nz = 0;  ///< points per axis

  Vec3d world(Vec3d index) const { return origin + index * spacing; }
  std::int64_t layer_points() const { return nx * ny; }

  /// Cubes of edge `spacing` that cover `bounds`, centred on it. Throws Error(usage) for an empty box, a spacing that
  /// is no positive number, and more than 4,096 points along an axis.
  static VoxelGrid covering(const Box& bounds, double spacing);
};

/// Values of layer z [ny * nx], x fastest; larger is denser. Asked once a layer, in ascending order.
using GridLayer = std::function<void(std::int64_t z, std::span<double> values)>;

/// Where the linearly interpolated values cross `level`; vertices in world units, every vertex once, no normals yet.
/// Closed but for the grid's own border: each inner edge belongs to exactly two triangles, which run along it in
/// opposite directions (faces of a cube with two dense corners across a diagonal are always cut corner by corner, so
/// that both cubes agree; no triangle's inner edge lies in a face). Memory beside the result: two layers of values and
/// two of vertex numbers. Throws
/// Error(data) for a value that is not a number, and for more than 2^32 - 2 vertices.
Surface marching_cubes(const VoxelGrid& grid, double level, const GridLayer& layer);

/// Triangles of one sign pattern; corners are numbers of cube edges.
struct CubeCase {
  std::vector<std::array<std::uint8_t, 3>> triangles;
};

/// Triangles of the 256 sign patterns. Bit c of the pattern: corner c is dense; corner c lies at (c & 1, c >> 1 & 1,
/// c >> 2). Edge 4 a + b runs along axis a; bits of b are its place along the next two axes (a + 1, a + 2 modulo 3).
const std::vector<CubeCase>& cube_cases();

}  // namespace semfield
