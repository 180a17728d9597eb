// Where a pixel of one view lies in another, and whether that view sees the same surface there.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "scene/camera.h"
#include "settings/fusion_params.h"

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

/// Pixel of a view that a world point falls on.
struct PixelHit {
  std::int32_t column = 0, row = 0;
  double z_m = 0;  ///< z-depth of the point in that view
};

/// None for a point behind the camera or outside the image, or outside the field of view of a distorting lens (whose
/// polynomial folds such points back into the image).
std::optional<PixelHit> project_point(const Camera& camera, const Pose& world_from_camera, Vec3d point);

/// Whether the surface in a pixel of `view` is the one at z-depth `z_m` there (FusionParams::agree). False without
/// depth: what the pixel sees is then unknown.
bool same_surface(const PosedDepth& view, std::size_t pixel, double z_m, const FusionParams& params);

/// The pixel of `view` that sees `point`: project_point and same_surface.
std::optional<PixelHit> seen_at(const PosedDepth& view, Vec3d point, const FusionParams& params);

/// Which of `others` (ascending, without the target) are asked for `target`, ascending. `views` 0: all. `even`: ranks
/// floor((k + 1/2) n / views). `nearest`: the least |c - c'| + |g - g'|, c a camera's centre and g the point on its
/// axis at the median depth of the target (1 without depth), so that turning counts like moving; of equals the earlier
/// one.
std::vector<int> choose_views(std::span<const PosedDepth> views, int target, std::vector<int> others,
                              const FusionParams& params);

}  // namespace semfield
