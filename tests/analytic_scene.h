// A small room rendered by formulas: a dataset without files whose truth is exact, for tests of everything downstream.
// A box with two balls and a crate, shaded without a view-dependent part.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>

#include "scene/dataset.h"

namespace semfield::testkit {

struct AnalyticSceneOptions {
  int frames = 12;  ///< on a circle, looking across the room; every fourth is a test frame
  std::int32_t width_px = 48;
  std::int32_t height_px = 36;
  bool with_depth = true;
  bool with_labels = true;
};

/// What a ray meets in the analytic room. Colour is 0..1 display-referred and does not depend on the viewing direction.
struct AnalyticHit {
  double t_m = 0;
  Vec3d point, normal, color;
  int label = 0;  ///< internal class index: 0 wall, 1 floor, 2 ceiling, 3 ball, 4 crate
};

namespace analytic_room {

inline constexpr double kPi = 3.14159265358979323846;
inline const Box kRoom{{-2, -1.5, -1}, {2, 1.5, 1}};

enum Label : int { kWall, kFloor, kCeiling, kBall, kCrate };

struct Ball {
  Vec3d center;
  double radius;
  Vec3d color;
};
inline const Ball kBalls[] = {{{0.35, 0.3, -0.6}, 0.4, {0.85, 0.2, 0.15}},
                              {{-0.6, -0.25, -0.7}, 0.3, {0.2, 0.35, 0.85}}};
inline const Box kCrateBox{{-0.35, 0.35, -1.0}, {0.05, 0.75, -0.3}};
inline const Vec3d kCrateColor{0.8, 0.6, 0.2};
inline const Vec3d kLight{0.36, 0.48, 0.8};

// Slab test of an axis-aligned box: entry (from outside) or exit (from inside) and the face's outward axis.
inline bool hit_box(const Box& box, Vec3d o, Vec3d d, bool from_inside, double& t, Vec3d& normal) {
  double t_in = -1e300;
  double t_out = 1e300;
  int axis_in = 0;
  int axis_out = 0;
  for (int i = 0; i < 3; ++i) {
    if (d[i] == 0) {
      if (o[i] < box.lo[i] || o[i] > box.hi[i]) return false;
      continue;
    }
    const double a = (box.lo[i] - o[i]) / d[i];
    const double b = (box.hi[i] - o[i]) / d[i];
    if (std::min(a, b) > t_in) {
      t_in = std::min(a, b);
      axis_in = i;
    }
    if (std::max(a, b) < t_out) {
      t_out = std::max(a, b);
      axis_out = i;
    }
  }
  if (t_in > t_out || t_out < 0 || (!from_inside && t_in < 0)) return false;
  const int axis = from_inside ? axis_out : axis_in;
  t = from_inside ? t_out : t_in;
  normal = {};
  normal[axis] = d[axis] > 0 ? -1 : 1;  // towards the viewer: inward for the room, outward for the crate
  return true;
}

// |o + t d - c|^2 = r^2, nearer root.
inline bool hit_ball(const Ball& ball, Vec3d o, Vec3d d, double& t) {
  const Vec3d q = o - ball.center;
  const double b = dot(q, d);
  const double discriminant = b * b - dot(q, q) + ball.radius * ball.radius;
  if (discriminant < 0) return false;
  t = -b - std::sqrt(discriminant);
  return t > 0;
}

inline Vec3d room_color(Vec3d p, Vec3d normal) {
  if (normal.z > 0.5) {
    const auto tiles = static_cast<long>(std::floor(2 * p.x)) + static_cast<long>(std::floor(2 * p.y));
    return tiles % 2 == 0 ? Vec3d{0.45, 0.4, 0.35} : Vec3d{0.7, 0.65, 0.6};
  }
  if (normal.z < -0.5) return {0.9, 0.9, 0.92};
  return {0.55 + 0.1 * p.x, 0.7, 0.6 + 0.1 * p.y};
}

// Diffuse with a floor of ambient light, so that every surface keeps its hue.
inline Vec3d shaded(Vec3d color, Vec3d normal) { return color * (0.7 + 0.3 * std::abs(dot(normal, kLight))); }

inline std::uint8_t to_byte(double value) {
  return static_cast<std::uint8_t>(std::lround(255 * std::clamp(value, 0.0, 1.0)));
}

}  // namespace analytic_room

/// First surface along a ray that starts inside the room (4 m x 3 m x 2 m around the origin, z up).
inline AnalyticHit intersect_analytic_room(Vec3d origin, Vec3d unit_direction) {
  using namespace analytic_room;
  AnalyticHit hit;
  hit_box(kRoom, origin, unit_direction, true, hit.t_m, hit.normal);
  hit.point = origin + unit_direction * hit.t_m;
  hit.label = hit.normal.z > 0.5 ? kFloor : hit.normal.z < -0.5 ? kCeiling : kWall;
  hit.color = room_color(hit.point, hit.normal);
  double t = 0;
  for (const Ball& ball : kBalls) {
    if (!hit_ball(ball, origin, unit_direction, t) || t >= hit.t_m) continue;
    const Vec3d point = origin + unit_direction * t;
    hit = {t, point, (point - ball.center) * (1 / ball.radius), ball.color, kBall};
  }
  Vec3d normal;
  if (hit_box(kCrateBox, origin, unit_direction, false, t, normal) && t < hit.t_m) {
    hit = {t, origin + unit_direction * t, normal, kCrateColor, kCrate};
  }
  hit.color = shaded(hit.color, hit.normal);
  return hit;
}

namespace analytic_room {

class AnalyticScene final : public Dataset {
 public:
  explicit AnalyticScene(const AnalyticSceneOptions& options) : options_(options) {}

  SceneInfo open(Diagnostics&) override {
    scene_ = {};
    scene_.name = "analytic_room";
    scene_.bounds = kRoom;
    scene_.near_hint_m = 0.05;
    scene_.far_hint_m = 5.0;
    scene_.classes = ClassTable({{0, "void", {0, 0, 0}, true},
                                 {1, "wall", {140, 180, 150}, false},
                                 {2, "floor", {150, 140, 130}, false},
                                 {3, "ceiling", {230, 230, 235}, false},
                                 {4, "ball", {200, 60, 60}, false},
                                 {5, "crate", {200, 150, 50}, false}});
    for (int i = 0; i < options_.frames; ++i) scene_.frames.push_back(frame(i));
    return scene_;
  }

  void read(int index, FrameBuffer& out) const override {
    const FrameInfo& info = scene_.frames.at(static_cast<std::size_t>(index));
    const Camera& camera = info.camera;
    out = {};
    out.width_px = camera.width_px;
    out.height_px = camera.height_px;
    for (std::int32_t row = 0; row < camera.height_px; ++row) {
      for (std::int32_t col = 0; col < camera.width_px; ++col) {
        const Vec3d in_camera =
            normalized(Vec3d{(col + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0});
        const AnalyticHit hit =
            intersect_analytic_room(info.world_from_camera.t, info.world_from_camera.rotate(in_camera));
        for (int c = 0; c < 3; ++c) out.rgb.push_back(to_byte(hit.color[c]));
        if (options_.with_depth) out.depth_m.push_back(static_cast<float>(hit.t_m * in_camera.z));
        if (options_.with_labels) out.label.push_back(static_cast<std::int16_t>(hit.label));
      }
    }
  }

 private:
  // Camera i of n on an ellipse just inside the walls, looking at the opposite side, a little downwards.
  FrameInfo frame(int i) const {
    const double angle = 2 * kPi * i / options_.frames;
    FrameInfo info;
    info.name = (i < 10 ? "view_0" : "view_") + std::to_string(i);
    info.source = "analytic_room/" + info.name;
    const double focal = 0.6 * options_.width_px;
    info.camera.width_px = options_.width_px;
    info.camera.height_px = options_.height_px;
    info.camera.fx = info.camera.fy = focal;
    info.camera.cx = 0.5 * options_.width_px;
    info.camera.cy = 0.5 * options_.height_px;
    const Vec3d center{1.6 * std::cos(angle), 1.2 * std::sin(angle), 0.2};
    const Vec3d target{-0.2 * std::cos(angle), -0.2 * std::sin(angle), -0.05};
    const Vec3d forward = normalized(target - center);
    const Vec3d right = normalized(cross(forward, Vec3d{0, 0, 1}));
    const Vec3d down = cross(forward, right);
    for (int k = 0; k < 3; ++k) {
      const auto row = static_cast<std::size_t>(k);
      info.world_from_camera.r[row] = {right[k], down[k], forward[k]};
    }
    info.world_from_camera.t = center;
    info.split = i % 4 == 3 ? Split::test : Split::train;
    info.has_depth = options_.with_depth;
    info.has_labels = options_.with_labels;
    return info;
  }

  AnalyticSceneOptions options_;
  SceneInfo scene_;
};

}  // namespace analytic_room

/// Frames 48 x 36 by default with colour, z-depth in metres and labels; ids 1..5 are the classes above and id 0 is
/// void. read() renders.
inline std::unique_ptr<Dataset> make_analytic_scene(const AnalyticSceneOptions& options = {}) {
  return std::make_unique<analytic_room::AnalyticScene>(options);
}

}  // namespace semfield::testkit
