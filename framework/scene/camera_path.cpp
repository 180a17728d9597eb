// Smooth paths through poses; pose files.
#include "scene/camera_path.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <sstream>
#include <system_error>

#include "core/check.h"
#include "formats/text_rows.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "system/files.h"

namespace semfield {

LevelAxes level_axes(Vec3d up) {
  const Vec3d helper = std::abs(up.x) < 0.9 ? Vec3d{1, 0, 0} : Vec3d{0, 1, 0};
  const Vec3d a = normalized(helper - up * dot(helper, up));
  return {up, a, cross(up, a)};
}

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
    pose.t = catmull_rom(keys[a].t, keys[b].t, keys[c].t, keys[d].t, t);
    Quaternion turn{};
    for (std::size_t k = 0; k < 4; ++k) turn[k] = catmull_rom(turns[a][k], turns[b][k], turns[c][k], turns[d][k], t);
    set_rotation(pose, turn);
    path.push_back(pose);
  }
  return path;
}

Pose look_along(Vec3d position, Vec3d forward, Vec3d up) {
  const Vec3d z = normalized(forward);
  Vec3d x = cross(z, up);
  // Straight up or down leaves the heading free: any level axis will do.
  x = length(x) > 1e-9 ? normalized(x) : level_axes(up).a;
  const Vec3d y = cross(z, x);
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    auto& r = pose.r[static_cast<std::size_t>(row)];
    r = {x[row], y[row], z[row]};
  }
  pose.t = position;
  return pose;
}

namespace {

Pose pose_of(const std::vector<double>& m, const std::string& where, CameraAxes axes) {
  Pose pose = pose_from_rows(m);
  const Vec3d x = pose.axis(0), y = pose.axis(1), z = pose.axis(2);
  const double off = std::max({std::abs(dot(x, y)), std::abs(dot(y, z)), std::abs(dot(x, z)), std::abs(length(x) - 1),
                               std::abs(length(y) - 1), std::abs(length(z) - 1)});
  if (!(off < 1e-3) || dot(cross(x, y), z) < 0) {
    throw Error(ErrorKind::data, "render.path.pose", where + ": the 3x3 part is not a rotation",
                "give camera-to-world matrices");
  }
  if (m.size() == 16 && (m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1)) {
    throw Error(ErrorKind::data, "render.path.pose", where + ": the last row is not 0 0 0 1",
                "give camera-to-world matrices, row by row");
  }
  if (axes == CameraAxes::right_up_backward) pose = opencv_from_opengl(pose);
  if (axes == CameraAxes::left_up_forward)
    for (auto& row : pose.r) row = {-row[0], -row[1], row[2]};
  make_rotation(pose);
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
        throw Error(ErrorKind::data, "render.path.number",
                    path + ":" + std::to_string(number) + ": '" + word.substr(0, 40) + "' is not a finite number",
                    "write finite numbers, and leave out poses that are lost");
      }
      row.push_back(tiny ? 0 : value);
    }
    if (row.size() != 16 && row.size() != 12 && row.size() != 4) {
      throw Error(
          ErrorKind::data, "render.path.format",
          path + ":" + std::to_string(number) + ": expected 4, 12 or 16 numbers, got '" + line.substr(0, 80) + "'",
          "write one camera-to-world matrix a line, or one matrix row a line");
    }
    rows.push_back(std::move(row));
    lines.push_back(number);
  }
  if (rows.empty())
    throw Error(ErrorKind::data, "render.path.empty", path + ": holds no pose",
                "write one camera-to-world matrix a line");
  std::size_t per_pose = 1;
  if (rows[0].size() == 4) per_pose = rows.size() >= 4 && rows[3] == std::vector<double>{0, 0, 0, 1} ? 4 : 3;
  if (rows.size() % per_pose != 0) {
    throw Error(ErrorKind::data, "render.path.format",
                path + ": " + std::to_string(rows.size()) + " lines are not a multiple of " + std::to_string(per_pose),
                "the file was cut short");
  }
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < rows.size(); i += per_pose) {
    std::vector<double> m;
    for (std::size_t k = 0; k < per_pose; ++k) m.insert(m.end(), rows[i + k].begin(), rows[i + k].end());
    const std::string where = path + ":" + std::to_string(lines[i]);
    if (m.size() != 12 && m.size() != 16)
      throw Error(ErrorKind::data, "render.path.format", where + ": expected 12 or 16 numbers a pose",
                  "write all poses of a file in the same form");
    poses.push_back(pose_of(m, where, axes));
  }
  return poses;
}

}  // namespace semfield
