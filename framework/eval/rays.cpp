#include "eval/rays.h"

#include <algorithm>
#include <cmath>

namespace semfield {

double cast_ray(const RayCamera& camera, const RayLimits& limits, std::int32_t column, std::int32_t row, double* origin,
                double* direction, double* near_far) {
  const Camera& c = camera.camera;
  const double u = column + 0.5, v = row + 0.5;
  const Vec3d local = camera.undistort ? c.direction(u, v) : normalized(Vec3d{(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1});
  const Vec3d d = camera.world_from_camera.rotate(local);
  const Vec3d o = camera.world_from_camera.t;
  for (int i = 0; i < 3; ++i) {
    origin[i] = o[i];
    direction[i] = d[i];
  }
  const double cosine = local.z;
  near_far[0] = near_far[1] = 0;
  if (cosine <= 0) {
    // No direction: a unit vector keeps the direction encoder's contract, the empty interval keeps the ray dark.
    // A camera that is not finite is no such case: its rays must be seen by who checks them.
    const bool is_finite = std::isfinite(c.fx) && std::isfinite(c.fy) && std::isfinite(c.cx) && std::isfinite(c.cy);
    const Vec3d forward = camera.world_from_camera.axis(2);
    for (int i = 0; i < 3; ++i) direction[i] = is_finite ? forward[i] : NAN;
    return 0;
  }
  double near_t = limits.z_depth ? limits.near_m / cosine : limits.near_m;
  double far_t = limits.z_depth ? limits.far_m / cosine : limits.far_m;
  if (limits.clip) {
    double enter = 0, leave = 0;
    if (!intersect(limits.bounds, o, d, enter, leave)) return cosine;
    near_t = std::max(near_t, enter);
    far_t = std::min(far_t, leave);
  }
  if (near_t < far_t) {
    near_far[0] = near_t;
    near_far[1] = far_t;
  }
  return cosine;
}

}  // namespace semfield
