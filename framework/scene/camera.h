// Cameras and their lenses, in house conventions; files of cameras, and paths through them.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/small_math.h"

namespace semfield {

/// How a lens puts rays on the image. perspective: a pinhole with OpenCV's radial and tangential polynomial [Brown66];
/// fisheye: the angle to the axis, with a polynomial [Kannala06]; equirectangular: longitude and latitude of a
/// panorama.
enum class LensKind : std::uint8_t { perspective, fisheye, equirectangular };

/// OpenCV axes (x right, y down, z forward). The centre of pixel (column i, row j) is (i + 0.5, j + 0.5): a dataset
/// with integer pixel centres adds 0.5 to cx and cy.
struct Camera {
  std::int32_t width_px = 0;
  std::int32_t height_px = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0;  ///< pixels; of a wide lens, fx and fy are pixels per radian
  double k1 = 0, k2 = 0, k3 = 0, k4 = 0;  ///< of r^2, r^4, r^6, r^8; r is the angle of a fisheye's ray
  double p1 = 0, p2 = 0;                  ///< tangential; of perspective lenses alone
  LensKind lens = LensKind::perspective;

  bool operator==(const Camera&) const = default;
  bool has_finite_lens() const {
    return std::isfinite(fx) && std::isfinite(fy) && std::isfinite(cx) && std::isfinite(cy);
  }
  /// A lens that may see behind itself, whose depth is therefore the distance along the ray.
  bool is_wide() const { return lens != LensKind::perspective; }
  /// False for a pinhole.
  bool has_distortion() const { return is_wide() || k1 != 0 || k2 != 0 || k3 != 0 || k4 != 0 || p1 != 0 || p2 != 0; }

  /// Unit direction in camera axes through image point (u, v) pixels. Undistorts by Newton's method when the lens has
  /// distortion; returns {0,0,0} where the lens has no ray (load_scene masks such pixels).
  Vec3d direction(double u, double v) const;
  /// Image point of a camera-space point that the camera sees(), distortion applied.
  void project(Vec3d p, double& u, double& v) const;
  /// Whether the lens can have a camera-space point in its image: z > 0, or of a wide lens any direction that it bends
  /// to one place.
  bool sees(Vec3d p) const;
  /// What depth images of this camera hold for a camera-space point: its z, or of a wide lens its distance. Of a unit
  /// direction: depth per distance along the ray.
  double depth_of(Vec3d p) const { return is_wide() ? length(p) : p.z; }
  /// False far outside the image, where the polynomial of a lens folds back into it: project() means nothing there.
  bool is_within_lens(Vec3d p) const {
    if (!has_distortion()) return true;
    if (is_wide()) return sees(p);
    const double u = fx * p.x / p.z + cx, v = fy * p.y / p.z + cy;
    return std::abs(u - 0.5 * width_px) < width_px && std::abs(v - 0.5 * height_px) < height_px;
  }
  /// The same camera for images scaled to width x height.
  Camera resized(std::int32_t width, std::int32_t height) const;
};

// Rotations of poses: the nearest one to a matrix, and quaternions.

/// w, x, y, z.
using Quaternion = std::array<double, 4>;

/// Puts the rotation in place of the pose's 3 x 3 part that is nearest to it, by the Frobenius norm. The part must be
/// finite and its determinant positive.
void make_rotation(Pose& pose);

Quaternion quaternion_of(const Pose& pose);

/// The turn of the quaternion, whose length does not matter. One that is zero or not finite gives a pose that is not
/// finite.
void set_rotation(Pose& pose, const Quaternion& turn);

// Cameras as a file: what `render` rendered, and what it can render again.

/// A camera at a place, with the limits of its rays.
struct PlacedCamera {
  std::string name;  ///< of its images
  Camera camera;
  Pose world_from_camera;
  double near_m = 0, far_m = 0;  ///< both 0: not told
};

/// Of one file. `z_depth`: near and far are z-depths; false: distances along the ray. `depth_step`: of the depth
/// pictures beside the file, in units of the scene; 0: there are none. It is written and not read.
struct CameraSet {
  std::vector<PlacedCamera> cameras;
  bool z_depth = false;
  double depth_step = 0;
};

/// JSON, a line a camera; numbers are read back to the bit.
void write_cameras(const std::string& path, const CameraSet& set);

/// Whether a file is one of JSON, not of matrices in rows (read_camera_file): it begins with a brace or a bracket.
bool is_camera_set(const std::string& path);

/// Throws Error(data) that names the file and every camera that cannot be used: keys that are missing, unknown or of
/// another kind, sizes over `limits`, lenses and poses as check_camera and check_pose refuse them, near >= far, and
/// names that are empty, hold control characters or stand twice ('/' and '_' are the same in a file's name). Warnings
/// go to the diagnostics, which must be fresh.
CameraSet read_cameras(const std::string& path, Diagnostics& diagnostics);

// Camera trajectories: smooth ones through given poses, and those of files.

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
/// 0 1). Throws Error(data) with file and line for anything else and for parts that are not a rotation (off by over
/// 1e-3); rotations are made orthonormal.
std::vector<Pose> read_camera_file(const std::string& path, CameraAxes axes);

}  // namespace semfield
