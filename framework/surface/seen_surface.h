// Find what a view sees of the surface in each of its pixels: places in the world, normals, and borders of depth.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "scene/camera.h"

namespace semfield {

/// Camera, pose and z-depth of a view.
struct PosedDepth {
  Camera camera;
  Pose world_from_camera;
  std::span<const float> depth_m;  ///< [H * W] z-depth, 0 = none

  std::size_t pixel(std::int32_t column, std::int32_t row) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(camera.width_px) + static_cast<std::size_t>(column);
  }
};

/// World point that the centre of a pixel sees; none where it has no depth (0, negative, not finite), or where the lens
/// has no inverse.
std::optional<Vec3d> surface_point(const PosedDepth& view, std::int32_t column, std::int32_t row);

/// Where a world point falls in an image.
struct PixelHit {
  std::int32_t column = 0, row = 0;
  double z_m = 0;       ///< z-depth of the point in that view
  double u = 0, v = 0;  ///< image point in pixels
};

/// None for a point behind the camera or outside the image, or outside the field of view of a distorting lens (whose
/// polynomial folds such points back into the image).
std::optional<PixelHit> project_point(const Camera& camera, const Pose& world_from_camera, Vec3d point);

/// Pixels of a view, or every so many of them, row by row.
struct SeenSurface {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<Vec3d> place;        ///< NaN where the view sees nothing
  std::vector<Vec3d> normal;       ///< towards the camera; 0 where there is none
  std::vector<double> distance_m;  ///< from the camera, 0 for nothing
  /// No border of depth beside the pixel, whose four neighbours see something too.
  bool is_interior(std::int64_t pixel) const;
};

bool is_place(Vec3d point);

/// World points of a view's pixels [H * W], NaN for none.
std::vector<Vec3d> surface_points(const PosedDepth& view);

/// `place` [height * width] as seen from `eye`. A normal is the cross product of the ways to the nearer of the two
/// neighbours along the row and along the column, so that edges of depth do not turn it.
SeenSurface seen_surface(std::vector<Vec3d> place, std::int32_t width_px, Vec3d eye);

}  // namespace semfield
