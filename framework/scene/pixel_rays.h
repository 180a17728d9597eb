// A pixel's ray in the world from its direction in the camera: the same bits on a CPU and on a device.
#pragma once

#include <cmath>

#include "core/small_math.h"
#include "core/view.h"

namespace semfield {

struct RayLimits {
  double near_m = 0.05;
  double far_m = 10;
  bool z_depth = false;  ///< near and far are z-depths; false: distances along the ray
  bool clip = false;     ///< clip to `bounds` (encoders whose domain is a cube)
  Box bounds;
};

/// Direction in camera axes through image point (u, v) of a lens without distortion.
SEMFIELD_HD inline Vec3d pinhole_direction(double fx, double fy, double cx, double cy, double u, double v) {
  return normalized(Vec3d{(u - cx) / fx, (v - cy) / fy, 1});
}

/// What of a camera is no array: `finite`, fx, fy, cx and cy are; `wide`, depth is the distance (Camera::depth_of).
struct RayLens {
  bool finite = true, wide = false;
};

/// cast_ray (eval/evaluator.h) from the unit direction `local` in camera axes, {0, 0, 0} for a pixel without one.
SEMFIELD_HD inline double ray_of_direction(const Vec3d& local, const Pose& world_from_camera, RayLens lens,
                                           const RayLimits& limits, double* origin, double* direction,
                                           double* near_far) {
  const Vec3d d = world_from_camera.rotate(local);
  const Vec3d o = world_from_camera.t;
  for (int i = 0; i < 3; ++i) {
    origin[i] = o[i];
    direction[i] = d[i];
  }
  const double cosine = lens.wide ? length(local) : local.z;
  near_far[0] = near_far[1] = 0;
  if (cosine <= 0) {
    // No direction: a unit vector keeps the direction encoder's contract, the empty interval keeps the ray dark.
    // A camera that is not finite is no such case: its rays must be seen by who checks them.
    const Vec3d forward = world_from_camera.axis(2);
    for (int i = 0; i < 3; ++i) direction[i] = lens.finite ? forward[i] : static_cast<double>(NAN);
    return 0;
  }
  double near_t = limits.z_depth ? limits.near_m / cosine : limits.near_m;
  double far_t = limits.z_depth ? limits.far_m / cosine : limits.far_m;
  if (limits.clip) {
    double enter = 0, leave = 0;
    if (!intersect(limits.bounds, o, d, enter, leave)) return cosine;
    if (near_t < enter) near_t = enter;
    if (leave < far_t) far_t = leave;
  }
  if (near_t < far_t) {
    near_far[0] = near_t;
    near_far[1] = far_t;
  }
  return cosine;
}

}  // namespace semfield
