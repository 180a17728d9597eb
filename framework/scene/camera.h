// Pinhole cameras with the OpenCV lens model, in house conventions.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/small_math.h"

namespace semfield {

/// OpenCV axes (x right, y down, z forward). The centre of pixel (column i, row j) is (i + 0.5, j + 0.5): a dataset
/// with integer pixel centres adds 0.5 to cx and cy.
struct Camera {
  std::int32_t width_px = 0;
  std::int32_t height_px = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0;  ///< pixels
  double k1 = 0, k2 = 0, k3 = 0, k4 = 0;  ///< radial: k1..k3 polynomial, k4 as the r^8 term
  double p1 = 0, p2 = 0;                  ///< tangential

  bool has_finite_lens() const {
    return std::isfinite(fx) && std::isfinite(fy) && std::isfinite(cx) && std::isfinite(cy);
  }
  bool has_distortion() const { return k1 != 0 || k2 != 0 || k3 != 0 || k4 != 0 || p1 != 0 || p2 != 0; }

  /// Unit direction in camera axes through image point (u, v) pixels. Undistorts by Newton's method when the lens has
  /// distortion; returns {0,0,0} where the distortion has no inverse (the pixel must then be masked).
  Vec3d direction(double u, double v) const;
  /// Image point of a camera-space point with z > 0, distortion applied.
  void project(Vec3d p, double& u, double& v) const;
  /// False far outside the image, where the polynomial of a lens folds back into it: project() means nothing there.
  bool is_within_lens(Vec3d p) const {
    if (!has_distortion()) return true;
    const double u = fx * p.x / p.z + cx, v = fy * p.y / p.z + cy;
    return std::abs(u - 0.5 * width_px) < width_px && std::abs(v - 0.5 * height_px) < height_px;
  }
  /// The same camera for images scaled to width x height.
  Camera resized(std::int32_t width, std::int32_t height) const;
};

}  // namespace semfield
