// Thin the surface that several views show to one point per cell, with the mean colour and normal of what lies there.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/small_math.h"
#include "scene/stored_frame.h"
#include "surface/seen_surface.h"
#include "surface/surface_cells.h"
#include "surface/surface_map.h"

namespace semfield {

/// A view of the pool: its camera and the surface that it sees.
struct PoolView {
  int frame = 0;  ///< in SceneInfo::frames
  RayCamera camera;
  const StoredFrame* photo = nullptr;  ///< borrowed
  SurfaceMap map;                      ///< empty: not seen yet
};

/// A cell of the surface, and where it is seen best: in a view's middle rather than at a border of depth, and from
/// near.
struct PoolPoint {
  Vec3d position;  ///< mean of what lies in the cell
  Vec3d normal;    ///< unit mean of what is seen of it, towards the cameras; 0 where there is none
  Vec3d color;     ///< mean of the photographs there, 0 to 1
  double pixels = 0;
  int view = 0;
  PixelPlace pixel;
  double distance_m = 0;  ///< from which `view` sees it
  bool interior = false;  ///< no border of depth beside `pixel`
};

/// What |difference|^2 / (2 sigma^2) of colours and of normals counts between two points.
struct PointDifference {
  double color = 0, normal = 0;
};
PointDifference difference(const PoolPoint& a, const PoolPoint& b, double color_sigma, double normal_sigma);

/// Views are added one by one, in an order that gives the cells their numbers; finish() then makes means of sums.
struct SurfacePool {
  SurfacePool() = default;
  SurfacePool(double cell_m, std::size_t views) : cells(cell_m), point_of_pixel(views) {}

  SurfaceCells cells;
  std::vector<PoolPoint> points;  ///< one per cell
  /// Of each view: the point that stands for each pixel of its map, -1 where it sees nothing.
  std::vector<std::vector<std::int32_t>> point_of_pixel;

  double cell_m() const { return cells.edge_m(); }  ///< 0 without cells
  /// `stride`: of the pixels that `seen` has, in `photo`.
  void add(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
    number(view, seen, photo, stride);
    gather(view, seen, photo, stride);
  }
  /// add() in two parts: cells get their numbers, then points what lies in them.
  void number(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride);
  void gather(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride);
  void finish();
};

/// Of some `wanted` points; the cells are sized for that. The same for the same maps.
SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted);

}  // namespace semfield
