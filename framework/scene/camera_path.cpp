// Path generation by rejection in free space; pose files.
#include "scene/camera_path.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <sstream>
#include <system_error>

#include "core/check.h"
#include "core/files.h"
#include "core/rng.h"
#include "scene/input_limits.h"

namespace semfield {
namespace {

constexpr double kPi = 3.141592653589793;
constexpr double kGoldenAngle = 2.399963229728653;
constexpr int kPosesPerKey = 4;
constexpr int kCandidates = 160;
constexpr double kNearestView_m = 0.6;  // a surface nearer than this in the image centre fills the picture

struct Key {
  Vec3d position;
  double yaw = 0, pitch = 0;
};

struct Axes {
  Vec3d up, a, b;  // a, b level, right-handed a x b = up
  Vec3d direction(double yaw, double pitch) const {
    return (a * std::cos(yaw) + b * std::sin(yaw)) * std::cos(pitch) + up * std::sin(pitch);
  }
};

Axes axes_of(Vec3d up) {
  const Vec3d helper = std::abs(up.x) < 0.9 ? Vec3d{1, 0, 0} : Vec3d{0, 1, 0};
  const Vec3d a = normalized(helper - up * dot(helper, up));
  return {up, a, cross(up, a)};
}

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
                           const Axes& axes) {
  const RandomAddress order{s.seed, 1, stream_id("camera_path/order")};
  const RandomAddress gaze{s.seed, 2, stream_id("camera_path/gaze")};
  const int count = (s.poses + kPosesPerKey - 1) / kPosesPerKey + 1;
  std::vector<Key> keys;
  std::vector<std::size_t> visited{static_cast<std::size_t>(uniform_below(order, 0, points.size()))};
  double yaw = 2 * kPi * static_cast<double>(uniform01(gaze, 0));
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
      const double tilt = kPi / 180 * (-34 + 40 * static_cast<double>(uniform01(gaze, index + 1)));
      const double view = view_distance(rays, key.position, axes.direction(turn, tilt));
      if (view <= best_view) continue;
      best_view = view;
      key.yaw = turn;
      key.pitch = tilt;
      if (view > 2 * kNearestView_m) break;
    }
    if (!keys.empty()) {
      while (key.yaw - keys.back().yaw > kPi) key.yaw -= 2 * kPi;
      while (key.yaw - keys.back().yaw < -kPi) key.yaw += 2 * kPi;
    }
    keys.push_back(key);
  }
  return keys;
}

// Uniform Catmull-Rom between b (t = 0) and c (t = 1).
template <class T>
T spline(T a, T b, T c, T d, double t) {
  return (b * 2.0 + (c - a) * t + (a * 2.0 - b * 5.0 + c * 4.0 - d) * (t * t) +
          (b * 3.0 - c * 3.0 + d - a) * (t * t * t)) *
         0.5;
}

using Quaternion = std::array<double, 4>;  // w, x, y, z

// Of the rotation's four expressions the one with the largest divisor.
Quaternion quaternion_of(const Pose& pose) {
  const auto& r = pose.r;
  const double squares[4] = {1 + r[0][0] + r[1][1] + r[2][2], 1 + r[0][0] - r[1][1] - r[2][2],
                             1 - r[0][0] + r[1][1] - r[2][2], 1 - r[0][0] - r[1][1] + r[2][2]};
  const auto largest = std::max_element(std::begin(squares), std::end(squares)) - std::begin(squares);
  const double s = 0.5 / std::sqrt(squares[largest]), q = squares[largest] * s;
  const double xw = (r[2][1] - r[1][2]) * s, yw = (r[0][2] - r[2][0]) * s, zw = (r[1][0] - r[0][1]) * s;
  const double xy = (r[0][1] + r[1][0]) * s, xz = (r[0][2] + r[2][0]) * s, yz = (r[1][2] + r[2][1]) * s;
  switch (largest) {
    case 0:
      return {q, xw, yw, zw};
    case 1:
      return {xw, q, xy, xz};
    case 2:
      return {yw, xy, q, yz};
    default:
      return {zw, xz, yz, q};
  }
}

void set_rotation(Pose& pose, Quaternion q) {
  double size = 0;
  for (const double v : q) size += v * v;
  const double scale = 1 / std::sqrt(size);
  for (double& v : q) v *= scale;
  const auto [w, x, y, z] = q;
  pose.r = {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
             {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
             {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

}  // namespace

std::vector<Pose> make_smooth_path(const std::vector<Pose>& keys, int count) {
  SEMFIELD_CHECK(!keys.empty(), "a path needs a pose");
  std::vector<Quaternion> turns;
  for (const Pose& key : keys) {
    Quaternion q = quaternion_of(key);
    double along = 0;
    for (std::size_t i = 0; i < 4 && !turns.empty(); ++i) along += q[i] * turns.back()[i];
    // q and -q are one turn: the shorter way from the key before.
    for (double& v : q) v = along < 0 ? -v : v;
    turns.push_back(q);
  }
  const std::size_t last = keys.size() - 1;
  std::vector<Pose> path;
  for (int i = 0; i < count; ++i) {
    const double at = count > 1 ? static_cast<double>(i) * static_cast<double>(last) / (count - 1) : 0;
    const std::size_t b = std::min(static_cast<std::size_t>(at), last), c = std::min(b + 1, last);
    const std::size_t a = b > 0 ? b - 1 : b, d = std::min(c + 1, last);
    const double t = at - static_cast<double>(b);
    Pose pose;
    pose.t = spline(keys[a].t, keys[b].t, keys[c].t, keys[d].t, t);
    Quaternion turn{};
    for (std::size_t k = 0; k < 4; ++k) turn[k] = spline(turns[a][k], turns[b][k], turns[c][k], turns[d][k], t);
    set_rotation(pose, turn);
    path.push_back(pose);
  }
  return path;
}

Pose look_along(Vec3d position, Vec3d forward, Vec3d up) {
  const Vec3d z = normalized(forward);
  Vec3d x = cross(z, up);
  // Straight up or down leaves the heading free: any level axis will do.
  x = length(x) > 1e-9 ? normalized(x) : axes_of(up).a;
  const Vec3d y = cross(z, x);
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    auto& r = pose.r[static_cast<std::size_t>(row)];
    r = {x[row], y[row], z[row]};
  }
  pose.t = position;
  return pose;
}

std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& s) {
  const std::vector<Vec3d> all = free_positions(rays, s);
  const std::vector<Vec3d> points = all.empty() ? all : largest_room(rays, all);
  if (points.size() < 4) {
    throw Error(ErrorKind::data,
                "no free space for cameras: " + std::to_string(points.size()) + " of 4000 positions are free",
                "lower scene.clearance_m or set scene.bounds to the inside of the room");
  }
  const Axes axes = axes_of(s.up);
  const std::vector<Key> keys = make_keys(rays, s, points, axes);
  std::vector<Pose> poses;
  for (int i = 0; i < s.poses; ++i) {
    const double at = static_cast<double>(i) * static_cast<double>(keys.size() - 1) / s.poses;
    const auto k = static_cast<std::size_t>(at);
    const double t = at - static_cast<double>(k);
    const Key &b = keys[k], &c = keys[k + 1];
    const Key &a = k > 0 ? keys[k - 1] : b, &d = k + 2 < keys.size() ? keys[k + 2] : c;
    Vec3d p = spline(a.position, b.position, c.position, d.position, t);
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
    const double pitch = std::clamp(spline(a.pitch, b.pitch, c.pitch, d.pitch, t), -0.8, 0.3);
    const double yaw = spline(a.yaw, b.yaw, c.yaw, d.yaw, t);
    // The nearest turn that does not stare at something close by.
    double turn = 0;
    for (int n = 0; n < 18; ++n) {
      const double tried = (n % 2 == 0 ? 1 : -1) * ((n + 1) / 2) * (kPi / 9);
      if (view_distance(rays, p, axes.direction(yaw + tried, pitch)) < kNearestView_m) continue;
      turn = tried;
      break;
    }
    poses.push_back(look_along(p, axes.direction(yaw + turn, pitch), s.up));
  }
  return poses;
}

namespace {

Pose pose_of(const std::vector<double>& m, const std::string& where, CameraAxes axes) {
  Vec3d column[3];
  for (int c = 0; c < 3; ++c) {
    column[c] = {m[static_cast<std::size_t>(c)], m[static_cast<std::size_t>(4 + c)],
                 m[static_cast<std::size_t>(8 + c)]};
  }
  const double off = std::max({std::abs(dot(column[0], column[1])), std::abs(dot(column[1], column[2])),
                               std::abs(dot(column[0], column[2])), std::abs(length(column[0]) - 1),
                               std::abs(length(column[1]) - 1), std::abs(length(column[2]) - 1)});
  if (!(off < 1e-3) || dot(cross(column[0], column[1]), column[2]) < 0) {
    throw Error(ErrorKind::data, where + ": the 3x3 part is no rotation", "give camera-to-world matrices");
  }
  if (m.size() == 16 && (m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1)) {
    throw Error(ErrorKind::data, where + ": the last row is not 0 0 0 1", "give camera-to-world matrices, row by row");
  }
  if (axes != CameraAxes::right_down_forward) column[1] = column[1] * -1.0;
  if (axes == CameraAxes::right_up_backward) column[2] = column[2] * -1.0;
  if (axes == CameraAxes::left_up_forward) column[0] = column[0] * -1.0;
  const Vec3d z = normalized(column[2]);
  const Vec3d x = normalized(column[0] - z * dot(column[0], z));
  const Vec3d y = cross(z, x);
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    auto& r = pose.r[static_cast<std::size_t>(row)];
    r = {x[row], y[row], z[row]};
  }
  pose.t = {m[3], m[7], m[11]};
  return pose;
}

}  // namespace

std::vector<Pose> read_camera_file(const std::string& path, CameraAxes axes) {
  std::istringstream stream(read_pose_file(path));
  std::vector<std::vector<double>> rows;
  std::vector<int> lines;
  std::string line;
  for (int number = 1; std::getline(stream, line); ++number) {
    const auto first = line.find_first_not_of(" \t\r");
    if (first == std::string::npos || line[first] == '#') continue;
    std::istringstream words(line);
    std::vector<double> row;
    for (std::string word; words >> word;) {
      double value = 0;
      const char* begin = word.data() + (word.size() > 1 && word[0] == '+' ? 1 : 0);
      const auto [end, code] = std::from_chars(begin, word.data() + word.size(), value);
      const bool tiny = code == std::errc::result_out_of_range && word.find("e-") != std::string::npos;
      if (end != word.data() + word.size() || !(code == std::errc{} || tiny) || !std::isfinite(value)) {
        throw Error(ErrorKind::data,
                    path + ":" + std::to_string(number) + ": '" + word.substr(0, 40) + "' is not a finite number",
                    "write finite numbers, and leave out poses that are lost");
      }
      row.push_back(tiny ? 0 : value);
    }
    if (row.size() != 16 && row.size() != 12 && row.size() != 4) {
      throw Error(
          ErrorKind::data,
          path + ":" + std::to_string(number) + ": expected 4, 12 or 16 numbers, got '" + line.substr(0, 80) + "'",
          "write one camera-to-world matrix a line, or one matrix row a line");
    }
    rows.push_back(std::move(row));
    lines.push_back(number);
  }
  if (rows.empty()) throw Error(ErrorKind::data, path + ": holds no pose", "write one camera-to-world matrix a line");
  std::size_t per_pose = 1;
  if (rows[0].size() == 4) per_pose = rows.size() >= 4 && rows[3] == std::vector<double>{0, 0, 0, 1} ? 4 : 3;
  if (rows.size() % per_pose != 0) {
    throw Error(ErrorKind::data,
                path + ": " + std::to_string(rows.size()) + " lines are no multiple of " + std::to_string(per_pose),
                "the file was cut short");
  }
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < rows.size(); i += per_pose) {
    std::vector<double> m;
    for (std::size_t k = 0; k < per_pose; ++k) m.insert(m.end(), rows[i + k].begin(), rows[i + k].end());
    const std::string where = path + ":" + std::to_string(lines[i]);
    if (m.size() != 12 && m.size() != 16)
      throw Error(ErrorKind::data, where + ": expected 12 or 16 numbers a pose",
                  "write all poses of a file in the same form");
    poses.push_back(pose_of(m, where, axes));
  }
  return poses;
}

}  // namespace semfield
