// Camera trajectories inside a mesh: generated in free space, or read from a file.
#pragma once

#include <string>
#include <vector>

#include "core/small_math.h"
#include "scene/raycast.h"

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

/// Camera at `position` looking along `forward`, its x axis level.
Pose look_along(Vec3d position, Vec3d forward, Vec3d up);

/// `count` poses along a smooth curve through `keys` in their order, ends included: Catmull-Rom for centres, and for
/// turns the same over unit quaternions, made unit again. One key stands still. `keys` must not be empty.
std::vector<Pose> make_smooth_path(const std::vector<Pose>& keys, int count);

/// Camera axes of a file's poses, as x, y, z of the camera.
enum class CameraAxes : std::uint8_t { right_down_forward, right_up_backward, left_up_forward };

/// Camera-to-world poses of a text file: 16 numbers a pose (4x4, one line or four, as traj_w_c.txt) or 12 (3x4). Which
/// of the two follows from the first line (16 or 12 numbers) or, with four numbers a line, from the fourth line (0 0 0
/// 1). Throws Error(data) with file and line for anything else and for parts that are no rotation (off by over 1e-3);
/// rotations are made orthonormal.
std::vector<Pose> read_camera_file(const std::string& path, CameraAxes axes);

}  // namespace semfield
