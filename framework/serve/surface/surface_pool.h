// The surface that all views together show, thinned to one point a cell: what is still uncertain is summed over it.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/small_math.h"
#include "scene/stored_frame.h"
#include "serve/surface/surface_map.h"

namespace semfield {

/// A view of the pool: its camera and the surface that it sees.
struct PoolView {
  int frame = 0;  ///< in SceneInfo::frames
  RayCamera camera;
  const StoredFrame* photo = nullptr;  ///< borrowed
  SurfaceMap map;                      ///< empty: not seen yet
};

/// Place of a cell in a regular grid, in cells from the origin.
using SurfaceCell = std::array<std::int32_t, 3>;
SurfaceCell surface_cell(Vec3d place, double edge_m);
std::uint64_t surface_cell_key(const SurfaceCell& cell);

/// Where a cell of the surface is seen best: in a view's middle rather than at a border of depth, and from near.
struct PoolPoint {
  Vec3d position;  ///< mean of what lies in the cell
  Vec3d normal;    ///< mean of what is seen of it, towards the cameras; 0 where there is none
  SurfaceCell cell{};
  int view = 0;
  PixelPlace pixel;
  bool interior = false;  ///< no border of depth beside it
  float color[3] = {};    ///< mean of the photographs there, 0 to 1
};

struct SurfacePool {
  double cell_m = 0;  ///< edge of a cell
  std::vector<PoolPoint> points;
  /// Of each view: the point that stands for each pixel of its map, -1 where the ray meets nothing.
  std::vector<std::vector<std::int32_t>> point_of_pixel;
};

/// Of some `wanted` points; the cells are sized for that. The same for the same maps.
SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted);

}  // namespace semfield
