// Camera trajectories generated in the free space of a mesh.
#pragma once

#include <cstdint>
#include <vector>

#include "core/small_math.h"
#include "datasets/obj_room/raycast.h"

namespace semfield {

struct PathSettings {
  int poses = 0;
  std::uint64_t seed = 0;
  Vec3d up{0, 0, 1};          ///< one of the world's axes
  Box region;                 ///< camera centres stay in it, world units
  double clearance_m = 0.35;  ///< no surface is nearer to a camera centre
  double lowest_m = 0.9;      ///< height above the floor of the region
  double highest_m = 1.9;
};

/// Seeded 6-DOF path, roll locked. Key positions are free, see surfaces in nearly every direction (so they lie inside
/// the room) and can see each other along free segments; key directions turn by the golden angle towards surfaces;
/// poses between the keys lie on a Catmull-Rom spline, or on the straight segment where the spline would come too near
/// to a surface. Throws Error(data) when the region has no free space.
std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& settings);

}  // namespace semfield
