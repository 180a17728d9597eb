// Cameras and their lenses, in house conventions.
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

}  // namespace semfield
