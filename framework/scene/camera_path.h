// Camera trajectories: smooth ones through given poses, and those of files.
#pragma once

#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "core/small_math.h"
#include "scene/camera.h"

namespace semfield {

/// A right-handed frame with `up`, one of the world's axes: a and b are level, a x b = up.
struct LevelAxes {
  Vec3d up, a, b;
  /// Unit direction; yaw turns from a to b, pitch towards up; radians.
  Vec3d direction(double yaw, double pitch) const {
    return (a * std::cos(yaw) + b * std::sin(yaw)) * std::cos(pitch) + up * std::sin(pitch);
  }
};
LevelAxes level_axes(Vec3d up);

/// Uniform Catmull-Rom between b (t = 0) and c (t = 1).
template <class T>
T catmull_rom(T a, T b, T c, T d, double t) {
  return (b * 2.0 + (c - a) * t + (a * 2.0 - b * 5.0 + c * 4.0 - d) * (t * t) +
          (b * 3.0 - c * 3.0 + d - a) * (t * t * t)) *
         0.5;
}

/// Camera at `position` looking along `forward`, its x axis level.
Pose look_along(Vec3d position, Vec3d forward, Vec3d up);

/// `count` poses along a smooth curve through `keys` in their order, ends included: Catmull-Rom for centres, and for
/// turns the same over unit quaternions, made unit again. One key stands still. `keys` must not be empty.
std::vector<Pose> make_smooth_path(const std::vector<Pose>& keys, int count);

/// Camera axes of a file's poses, as x, y, z of the camera.
enum class CameraAxes : std::uint8_t { right_down_forward, right_up_backward, left_up_forward };

/// Camera-to-world poses of a text file: 16 numbers a pose (4x4, one line or four, as traj_w_c.txt) or 12 (3x4). Which
/// of the two follows from the first line (16 or 12 numbers) or, with four numbers per line, from the fourth line (0 0
/// 0 1). Throws Error(data) with file and line for anything else and for parts that are not a rotation (off by over 1e-3);
/// rotations are made orthonormal.
std::vector<Pose> read_camera_file(const std::string& path, CameraAxes axes);

}  // namespace semfield
