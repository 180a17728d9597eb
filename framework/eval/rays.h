// From pixels to rays: unit directions, limits along the ray, clipping to the scene's bounds.
#pragma once

#include <cstdint>

#include "core/small_math.h"
#include "core/view.h"
#include "scene/camera.h"
#include "scene/pixel_rays.h"

namespace semfield {

/// Camera at a pose, ready to cast. `undistort` false: the caller knows that there is no distortion.
struct RayCamera {
  Camera camera;
  Pose world_from_camera;
  bool undistort = true;
};

/// Ray through the centre of pixel (column, row): origin [3], unit direction [3] in world axes, near_far [2] in metres
/// along the ray. A pixel without an inverse distortion, or a ray that misses the bounds, gets near = far = 0: an empty
/// ray. Returns the cosine between the ray and the optical axis, 1 of a wide lens: depth = cosine * distance (0 for a
/// pixel without direction).
double cast_ray(const RayCamera& camera, const RayLimits& limits, std::int32_t column, std::int32_t row, double* origin,
                double* direction, double* near_far);

}  // namespace semfield
