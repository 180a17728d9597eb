#include "eval/rays.h"

#include <cmath>

namespace semfield {

double cast_ray(const RayCamera& camera, const RayLimits& limits, std::int32_t column, std::int32_t row, double* origin,
                double* direction, double* near_far) {
  const Camera& c = camera.camera;
  const double u = column + 0.5, v = row + 0.5;
  const Vec3d local = camera.undistort ? c.direction(u, v) : pinhole_direction(c.fx, c.fy, c.cx, c.cy, u, v);
  return ray_of_direction(local, camera.world_from_camera, {c.has_finite_lens(), c.is_wide()}, limits, origin,
                          direction, near_far);
}

}  // namespace semfield
