// Up vectors and turns.
#include "surface/mesh/upright.h"

#include <fmt/format.h>

#include <cmath>

namespace semfield {

namespace {

constexpr double kNearAxis = 0.9397;  // cosine of 20 degrees
constexpr double kCancelled = 0.1;    // length of a mean of unit vectors that say nothing together

// x, -x, y, -y, z, -z.
Vec3d axis(int number) {
  Vec3d out;
  out[number / 2] = number % 2 == 0 ? 1 : -1;
  return out;
}

}  // namespace

std::optional<Vec3d> up_of_cameras(std::span<const Pose> world_from_camera) {
  Vec3d sum;
  for (const Pose& pose : world_from_camera) sum = sum - pose.axis(1);
  if (!(length(sum) > kCancelled * static_cast<double>(world_from_camera.size()))) return std::nullopt;
  const Vec3d mean = normalized(sum);
  for (int i = 0; i < 6; ++i) {
    if (dot(axis(i), mean) > kNearAxis) return axis(i);
  }
  return mean;
}

std::optional<Vec3d> axis_named(const std::string& name) {
  for (int i = 0; i < 6; ++i) {
    const std::string text = axis_text(axis(i));
    if (name == text || (i % 2 == 0 && name == text.substr(1))) return axis(i);
  }
  return std::nullopt;
}

std::string axis_text(Vec3d up) {
  for (int i = 0; i < 6; ++i) {
    if (up == axis(i)) return fmt::format("{}{}", i % 2 == 0 ? '+' : '-', "xyz"[i / 2]);
  }
  return fmt::format("({:.3f}, {:.3f}, {:.3f})", up.x, up.y, up.z);
}

std::array<double, 4> turn_to_y(Vec3d up) {
  const Vec3d y{0, 1, 0};
  if (up.y < -1 + 1e-12) return {1, 0, 0, 0};  // upside down: half a turn about any level axis
  const Vec3d about = cross(up, y);
  const double w = 1 + dot(up, y), norm = std::sqrt(dot(about, about) + w * w);
  return {about.x / norm, about.y / norm, about.z / norm, w / norm};
}

}  // namespace semfield
