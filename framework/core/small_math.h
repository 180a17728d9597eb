// Three-vectors and rigid transforms, small enough to need no library and safe to pass across module borders; values by
// their rank.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iterator>
#include <vector>

#include "core/view.h"

namespace semfield {

template <class T>
struct Vec3 {
  T x{}, y{}, z{};

  SEMFIELD_HD T& operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
  SEMFIELD_HD const T& operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
  SEMFIELD_HD friend Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  SEMFIELD_HD friend Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  SEMFIELD_HD friend Vec3 operator*(Vec3 a, T s) { return {a.x * s, a.y * s, a.z * s}; }
  SEMFIELD_HD friend Vec3 operator*(T s, Vec3 a) { return a * s; }
  bool operator==(const Vec3&) const = default;
};

template <class T>
SEMFIELD_HD inline T dot(Vec3<T> a, Vec3<T> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
SEMFIELD_HD inline Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
SEMFIELD_HD inline T length(Vec3<T> a) {
  return std::sqrt(dot(a, a));
}
template <class T>
SEMFIELD_HD inline Vec3<T> normalized(Vec3<T> a) {
  return a * (T(1) / length(a));
}

using Vec3d = Vec3<double>;

/// Rigid transform world_from_camera: columns of `r` are the camera's axes in the world (x right, y down, z forward),
/// `t` the camera centre in world units. r is row-major: r[row][col].
struct Pose {
  std::array<std::array<double, 3>, 3> r{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  Vec3d t;

  SEMFIELD_HD Vec3d axis(int col) const { return {r[0][col], r[1][col], r[2][col]}; }
  SEMFIELD_HD Vec3d rotate(Vec3d v) const {
    return {r[0][0] * v.x + r[0][1] * v.y + r[0][2] * v.z, r[1][0] * v.x + r[1][1] * v.y + r[1][2] * v.z,
            r[2][0] * v.x + r[2][1] * v.y + r[2][2] * v.z};
  }
  Vec3d unrotate(Vec3d v) const { return {dot(axis(0), v), dot(axis(1), v), dot(axis(2), v)}; }
  Vec3d apply(Vec3d p) const { return rotate(p) + t; }
  Vec3d apply_inverse(Vec3d p) const { return unrotate(p - t); }
};

/// Axis-aligned box in world units; empty while lo > hi.
struct Box {
  Vec3d lo{1e300, 1e300, 1e300};
  Vec3d hi{-1e300, -1e300, -1e300};

  bool empty() const { return lo.x > hi.x || lo.y > hi.y || lo.z > hi.z; }
  void include(Vec3d p) {
    for (int i = 0; i < 3; ++i) {
      if (p[i] < lo[i]) lo[i] = p[i];
      if (p[i] > hi[i]) hi[i] = p[i];
    }
  }
  Vec3d size() const { return hi - lo; }
  Vec3d center() const { return (lo + hi) * 0.5; }
};

/// Interval of t >= 0 where origin + t * direction lies in the box; false when the ray misses it. Zero direction
/// components are handled by containment of the origin, so no 0 * inf occurs.
SEMFIELD_HD inline bool intersect(const Box& box, Vec3d origin, Vec3d direction, double& t_near, double& t_far) {
  t_near = 0;
  t_far = 1e300;
  for (int i = 0; i < 3; ++i) {
    if (direction[i] == 0) {
      if (origin[i] < box.lo[i] || origin[i] > box.hi[i]) return false;
      continue;
    }
    double a = (box.lo[i] - origin[i]) / direction[i];
    double b = (box.hi[i] - origin[i]) / direction[i];
    if (a > b) {
      const double swap = a;
      a = b;
      b = swap;
    }
    if (a > t_near) t_near = a;
    if (b < t_far) t_far = b;
  }
  return t_near <= t_far;
}

// A length that stands for a metre, so that a default which is meant for rooms suits a scene in any unit.

/// Whether a scene of this size is in metres: as large as shelves, rooms and houses are.
inline bool is_in_metres(bool metric, Vec3d size) {
  const double longest = std::max({size.x, size.y, size.z});
  return metric && longest >= 0.1 && longest <= 100;
}

/// 1 where is_in_metres(), else a fifth of the scene's longest side; 1 for a scene without a size.
inline double usual_metre(bool metric, Vec3d size) {
  const double longest = std::max({size.x, size.y, size.z});
  return is_in_metres(metric, size) || !(longest > 0) || !std::isfinite(longest) ? 1 : longest / 5;
}

// Values by their rank.

/// The middle value, of an even number the upper one; 0 of none.
template <class T>
T median_of(std::vector<T> values) {
  if (values.empty()) return T(0);
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}
/// The value of rank floor(share * (n - 1)), share 0 to 1. Reorders `values`, which are not empty.
template <class T>
T quantile(std::vector<T>& values, double share) {
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

}  // namespace semfield
