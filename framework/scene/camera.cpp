// Lenses and their inverses: OpenCV's radial-tangential polynomial, the fisheye's and the panorama.
#include "scene/camera.h"

#include <cmath>
#include <numbers>

namespace semfield {

namespace {

struct Plane {
  double x = 0, y = 0;
};
double squared(Plane q) { return q.x * q.x + q.y * q.y; }

// Distorted normalised point and its Jacobian. s = x^2 + y^2, g = 1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4;
// x_d = x g + 2 p1 x y + p2 (s + 2 x^2), y_d = y g + p1 (s + 2 y^2) + 2 p2 x y  [Brown66].
Plane distort(const Camera& c, Plane q, double jacobian[4]) {
  const double s = q.x * q.x + q.y * q.y;
  const double g = 1 + s * (c.k1 + s * (c.k2 + s * (c.k3 + s * c.k4)));
  const double dg = c.k1 + s * (2 * c.k2 + s * (3 * c.k3 + s * 4 * c.k4));  // dg/ds
  const double xy = q.x * q.y;
  jacobian[0] = g + 2 * q.x * q.x * dg + 2 * c.p1 * q.y + 6 * c.p2 * q.x;
  jacobian[1] = 2 * xy * dg + 2 * c.p1 * q.x + 2 * c.p2 * q.y;
  jacobian[2] = jacobian[1];
  jacobian[3] = g + 2 * q.y * q.y * dg + 6 * c.p1 * q.y + 2 * c.p2 * q.x;
  return {q.x * g + 2 * c.p1 * xy + c.p2 * (s + 2 * q.x * q.x), q.y * g + c.p1 * (s + 2 * q.y * q.y) + 2 * c.p2 * xy};
}

// Newton with step halving from `q` towards distort(q) = target; false when it stalls or meets a fold.
bool newton(const Camera& c, Plane target, Plane& q) {
  double j[4];
  Plane at = distort(c, q, j);
  double residual = std::hypot(at.x - target.x, at.y - target.y);
  const double goal = 1e-13 * (1 + std::hypot(target.x, target.y));
  for (int iteration = 0; iteration < 50 && residual > goal; ++iteration) {
    const double det = j[0] * j[3] - j[1] * j[2];
    if (!(det > 1e-12)) return false;
    const double ex = target.x - at.x, ey = target.y - at.y;
    const Plane step{(j[3] * ex - j[1] * ey) / det, (j[0] * ey - j[2] * ex) / det};
    double scale = 1;
    bool better = false;
    for (int halving = 0; halving < 20 && !better; ++halving, scale *= 0.5) {
      const Plane trial{q.x + scale * step.x, q.y + scale * step.y};
      double trial_j[4];
      const Plane trial_at = distort(c, trial, trial_j);
      const double trial_residual = std::hypot(trial_at.x - target.x, trial_at.y - target.y);
      if (trial_residual < residual) {
        q = trial;
        at = trial_at;
        residual = trial_residual;
        for (int i = 0; i < 4; ++i) j[i] = trial_j[i];
        better = true;
      }
    }
    if (!better) break;  // at the rounding floor, or no way down
  }
  return residual <= 16 * goal && j[0] * j[3] - j[1] * j[2] > 1e-9;
}

// d(r g)/dr = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 + 9 k4 s^4 with s = r^2
double radial_slope(const Camera& c, double s) {
  return 1 + s * (3 * c.k1 + s * (5 * c.k2 + s * (7 * c.k3 + s * 9 * c.k4)));
}

// True while the radial part grows all the way from the axis to r^2 = `end`: beyond its first fold a point is the image
// of two rays, and only the inner one is the lens. Looked at in 32 steps.
bool inside_first_fold(const Camera& c, double end) {
  for (int i = 1; i <= 32; ++i) {
    if (!(radial_slope(c, end * i / 32) > 0)) return false;
  }
  return true;
}

bool undistort(const Camera& c, Plane target, Plane& out) {
  out = target;
  if (newton(c, target, out) && inside_first_fold(c, squared(out))) return true;
  // Strong lenses: walk from the axis outwards, each solution starting the next one.
  out = {};
  for (int i = 1; i <= 16; ++i) {
    if (!newton(c, {target.x * i / 16, target.y * i / 16}, out)) return false;
  }
  return inside_first_fold(c, squared(out));
}

// A fisheye's distance from the image's axis for a ray at `angle`: theta_d = theta (1 + k1 theta^2 + k2 theta^4 +
// k3 theta^6 + k4 theta^8) [Kannala06].
double fisheye_radius(const Camera& c, double angle) {
  const double s = angle * angle;
  return angle * (1 + s * (c.k1 + s * (c.k2 + s * (c.k3 + s * c.k4))));
}

// The angle whose radius is `target`; false beyond the first fold and beyond a half turn.
bool fisheye_angle(const Camera& c, double target, double& angle) {
  constexpr int kSteps = 64;
  double low = 0, high = 0;
  for (int i = 1;; ++i) {
    if (i > kSteps) return false;
    high = std::numbers::pi * i / kSteps;
    if (fisheye_radius(c, high) >= target) break;
    if (!(radial_slope(c, high * high) > 0)) return false;
    low = high;
  }
  // Newton's method, kept between the two by halving.
  angle = 0.5 * (low + high);
  for (int i = 0; i < 60; ++i) {
    const double off = fisheye_radius(c, angle) - target;
    (off > 0 ? high : low) = angle;
    const double step = off / radial_slope(c, angle * angle);
    if (std::abs(step) <= 4e-16 * (1 + angle)) break;
    const double next = angle - step;
    angle = next > low && next < high ? next : 0.5 * (low + high);
  }
  return radial_slope(c, angle * angle) > 0;
}

Vec3d fisheye_direction(const Camera& c, Plane q) {
  const double radius = std::hypot(q.x, q.y);
  if (!(radius > 0)) return {0, 0, radius == 0 ? 1.0 : 0.0};
  double angle = 0;
  if (!fisheye_angle(c, radius, angle)) return {0, 0, 0};
  const double scale = std::sin(angle) / radius;
  return normalized(Vec3d{q.x * scale, q.y * scale, std::cos(angle)});
}

// Longitude grows to the right and latitude downwards, from the axis.
Vec3d panorama_direction(Plane q) {
  if (!(std::abs(q.y) <= 0.5 * std::numbers::pi && std::isfinite(q.x))) return {0, 0, 0};
  return normalized(Vec3d{std::sin(q.x) * std::cos(q.y), std::sin(q.y), std::cos(q.x) * std::cos(q.y)});
}

}  // namespace

Vec3d Camera::direction(double u, double v) const {
  Plane q{(u - cx) / fx, (v - cy) / fy};
  if (lens == LensKind::fisheye) return fisheye_direction(*this, q);
  if (lens == LensKind::equirectangular) return panorama_direction(q);
  if (has_distortion()) {
    const Plane target = q;
    if (!undistort(*this, target, q)) return {0, 0, 0};
  }
  return normalized(Vec3d{q.x, q.y, 1.0});
}

bool Camera::sees(Vec3d p) const {
  if (!is_wide()) return p.z > 0;
  if (!(length(p) > 0)) return false;
  const double angle = std::atan2(std::hypot(p.x, p.y), p.z);
  return lens == LensKind::equirectangular || inside_first_fold(*this, angle * angle);
}

void Camera::project(Vec3d p, double& u, double& v) const {
  if (is_wide()) {
    const double across = std::hypot(p.x, p.y);
    Plane q{std::atan2(p.x, p.z), std::atan2(p.y, std::hypot(p.x, p.z))};
    if (lens == LensKind::fisheye) {
      const double scale = across > 0 ? fisheye_radius(*this, std::atan2(across, p.z)) / across : 0;
      q = {p.x * scale, p.y * scale};
    }
    u = fx * q.x + cx;
    v = fy * q.y + cy;
    // A panorama whose middle is not that of its image goes on at the other side.
    const double turn = 2 * std::numbers::pi * fx;
    if (lens == LensKind::equirectangular) u += u < 0 ? turn : u >= width_px ? -turn : 0;
    return;
  }
  Plane q{p.x / p.z, p.y / p.z};
  if (has_distortion()) {
    double jacobian[4];
    q = distort(*this, q, jacobian);
  }
  u = fx * q.x + cx;
  v = fy * q.y + cy;
}

Camera Camera::resized(std::int32_t width, std::int32_t height) const {
  // Image points run from 0 to width_px (pixel centres at +0.5), so every intrinsic scales by the same factor; the lens
  // polynomial works on normalised points and stays.
  const double sx = static_cast<double>(width) / width_px;
  const double sy = static_cast<double>(height) / height_px;
  Camera out = *this;
  out.width_px = width;
  out.height_px = height;
  out.fx *= sx;
  out.cx *= sx;
  out.fy *= sy;
  out.cy *= sy;
  return out;
}

}  // namespace semfield
