// Path generation by rejection in free space.
#include "datasets/obj_room/room_path.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/rng.h"
#include "scene/camera_path.h"

namespace semfield {
namespace {

using std::numbers::pi;
constexpr double kGoldenAngle = 2.399963229728653;
constexpr int kPosesPerKey = 4;
constexpr int kCandidates = 160;
constexpr double kNearestView_m = 0.6;  // a surface nearer than this in the image centre fills the picture

struct Key {
  Vec3d position;
  double yaw = 0, pitch = 0;
};

// Inside a room nearly every direction meets a surface (windows may be open).
bool enclosed(const Raycaster& rays, Vec3d p) {
  constexpr int kDirections = 48;
  int hits = 0;
  for (int i = 0; i < kDirections; ++i) {
    const double z = 1 - (2 * i + 1.0) / kDirections, r = std::sqrt(1 - z * z), phi = kGoldenAngle * i;
    if (rays.blocked(p, {r * std::cos(phi), r * std::sin(phi), z}, 100)) ++hits;
  }
  return hits * 10 >= kDirections * 8;
}

bool segment_free(const Raycaster& rays, Vec3d p, Vec3d q, double clearance_m) {
  const int steps = std::max(2, static_cast<int>(length(q - p) / 0.1));
  for (int i = 0; i <= steps; ++i) {
    const double t = static_cast<double>(i) / steps;
    if (rays.clearance(p + (q - p) * t, clearance_m) < clearance_m) return false;
  }
  return true;
}

std::vector<Vec3d> free_positions(const Raycaster& rays, const PathSettings& s) {
  const RandomAddress address{s.seed, 0, stream_id("camera_path/position")};
  int axis = 0;
  for (int k = 1; k < 3; ++k) {
    if (std::abs(s.up[k]) > std::abs(s.up[axis])) axis = k;
  }
  Box box = s.region;
  const bool flipped = s.up[axis] < 0;
  const double floor = flipped ? box.hi[axis] : box.lo[axis];
  const double sign = flipped ? -1 : 1;
  const double height = box.hi[axis] - box.lo[axis];
  const double low = std::min(s.lowest_m, 0.35 * height), high = std::min(s.highest_m, 0.8 * height);
  box.lo[axis] = std::min(floor + sign * low, floor + sign * high);
  box.hi[axis] = std::max(floor + sign * low, floor + sign * high);
  std::vector<Vec3d> out;
  for (std::uint64_t i = 0; i < 4000 && out.size() < kCandidates; ++i) {
    Vec3d p;
    for (int k = 0; k < 3; ++k) {
      p[k] = box.lo[k] +
             (box.hi[k] - box.lo[k]) * static_cast<double>(uniform01(address, 3 * i + static_cast<std::uint64_t>(k)));
    }
    if (rays.clearance(p, s.clearance_m) >= s.clearance_m && enclosed(rays, p)) out.push_back(p);
  }
  return out;
}

// The largest set of candidates that reach one another along sight lines: one room, not also the next one.
std::vector<Vec3d> largest_room(const Raycaster& rays, const std::vector<Vec3d>& points) {
  std::vector<int> room(points.size(), -1);
  std::vector<int> sizes;
  for (std::size_t start = 0; start < points.size(); ++start) {
    if (room[start] >= 0) continue;
    const int id = static_cast<int>(sizes.size());
    std::vector<std::size_t> open{start};
    room[start] = id;
    sizes.push_back(0);
    while (!open.empty()) {
      const std::size_t i = open.back();
      open.pop_back();
      ++sizes.back();
      for (std::size_t j = 0; j < points.size(); ++j) {
        if (room[j] >= 0) continue;
        const Vec3d way = points[j] - points[i];
        const double far = length(way);
        if (far > 0 && rays.blocked(points[i], way * (1 / far), far)) continue;
        room[j] = id;
        open.push_back(j);
      }
    }
  }
  const int best = static_cast<int>(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
  std::vector<Vec3d> out;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (room[i] == best) out.push_back(points[i]);
  }
  return out;
}

double view_distance(const Raycaster& rays, Vec3d p, Vec3d direction) {
  const RayHit hit = rays.trace(p, direction, 100);
  return hit.hit() ? hit.distance_m : 100;
}

std::vector<Key> make_keys(const Raycaster& rays, const PathSettings& s, const std::vector<Vec3d>& points,
                           const LevelAxes& axes) {
  const RandomAddress order{s.seed, 1, stream_id("camera_path/order")};
  const RandomAddress gaze{s.seed, 2, stream_id("camera_path/gaze")};
  const int count = (s.poses + kPosesPerKey - 1) / kPosesPerKey + 1;
  std::vector<Key> keys;
  std::vector<std::size_t> visited{static_cast<std::size_t>(uniform_below(order, 0, points.size()))};
  double yaw = 2 * pi * static_cast<double>(uniform01(gaze, 0));
  for (int k = 0; k < count; ++k) {
    if (k > 0) {
      // Of a few reachable candidates the one farthest from the last places visited.
      std::size_t best = visited.back();
      double best_score = -1;
      for (std::uint64_t n = 0, found = 0; n < 40 && found < 4; ++n) {
        const auto j =
            static_cast<std::size_t>(uniform_below(order, static_cast<std::uint64_t>(k) * 64 + n, points.size()));
        if (j == visited.back() || !segment_free(rays, points[visited.back()], points[j], s.clearance_m)) continue;
        ++found;
        double score = 1e9;
        for (std::size_t v = visited.size() > 12 ? visited.size() - 12 : 0; v < visited.size(); ++v) {
          score = std::min(score, length(points[visited[v]] - points[j]));
        }
        if (score > best_score) {
          best_score = score;
          best = j;
        }
      }
      visited.push_back(best);
      yaw += kGoldenAngle;
    }
    Key key{points[visited.back()], yaw, 0};
    double best_view = -1;
    for (std::uint64_t n = 0; n < 8; ++n) {
      const std::uint64_t index = 1 + static_cast<std::uint64_t>(k) * 16 + 2 * n;
      const double turn = yaw + 0.7 * (static_cast<double>(uniform01(gaze, index)) - 0.5);
      const double tilt = pi / 180 * (-34 + 40 * static_cast<double>(uniform01(gaze, index + 1)));
      const double view = view_distance(rays, key.position, axes.direction(turn, tilt));
      if (view <= best_view) continue;
      best_view = view;
      key.yaw = turn;
      key.pitch = tilt;
      if (view > 2 * kNearestView_m) break;
    }
    if (!keys.empty()) {
      while (key.yaw - keys.back().yaw > pi) key.yaw -= 2 * pi;
      while (key.yaw - keys.back().yaw < -pi) key.yaw += 2 * pi;
    }
    keys.push_back(key);
  }
  return keys;
}

}  // namespace

std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& s) {
  const std::vector<Vec3d> all = free_positions(rays, s);
  const std::vector<Vec3d> points = all.empty() ? all : largest_room(rays, all);
  if (points.size() < 4) {
    throw Error(ErrorKind::data, "scene.obj.space",
                "no free space for cameras: " + std::to_string(points.size()) + " of 4000 positions are free",
                "lower scene.clearance_m or set scene.bounds to the inside of the room");
  }
  const LevelAxes axes = level_axes(s.up);
  const std::vector<Key> keys = make_keys(rays, s, points, axes);
  std::vector<Pose> poses;
  for (int i = 0; i < s.poses; ++i) {
    const double at = static_cast<double>(i) * static_cast<double>(keys.size() - 1) / s.poses;
    const auto k = static_cast<std::size_t>(at);
    const double t = at - static_cast<double>(k);
    const Key &b = keys[k], &c = keys[k + 1];
    const Key &a = k > 0 ? keys[k - 1] : b, &d = k + 2 < keys.size() ? keys[k + 2] : c;
    Vec3d p = catmull_rom(a.position, b.position, c.position, d.position, t);
    const Vec3d way = p - b.position;
    const double far = length(way);
    if (rays.clearance(p, s.clearance_m) < s.clearance_m ||
        (far > 0 && rays.blocked(b.position, way * (1 / far), far))) {
      p = b.position + (c.position - b.position) * t;
    }
    // The segment was tried in steps: where it grazes something thin, halfway towards the nearer key, at last the key.
    const double key = t < 0.5 ? 0 : 1;
    for (double step = t, n = 0; rays.clearance(p, s.clearance_m) < s.clearance_m && n < 8; ++n) {
      step = n < 7 ? 0.5 * (step + key) : key;
      p = b.position + (c.position - b.position) * step;
    }
    const double pitch = std::clamp(catmull_rom(a.pitch, b.pitch, c.pitch, d.pitch, t), -0.8, 0.3);
    const double yaw = catmull_rom(a.yaw, b.yaw, c.yaw, d.yaw, t);
    // The nearest turn that does not stare at something close by.
    double turn = 0;
    for (int n = 0; n < 18; ++n) {
      const double tried = (n % 2 == 0 ? 1 : -1) * ((n + 1) / 2) * (pi / 9);
      if (view_distance(rays, p, axes.direction(yaw + tried, pitch)) < kNearestView_m) continue;
      turn = tried;
      break;
    }
    poses.push_back(look_along(p, axes.direction(yaw + turn, pitch), s.up));
  }
  return poses;
}

}  // namespace semfield
