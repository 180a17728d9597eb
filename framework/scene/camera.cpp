// Lenses and their inverses (OpenCV's radial-tangential polynomial, the fisheye's, the panorama), files of cameras, and
// paths.
#include "scene/camera.h"

#include <fmt/format.h>

#include <Eigen/Geometry>
#include <Eigen/SVD>
#include <algorithm>
#include <charconv>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>
#include <sstream>
#include <system_error>

#include "core/check.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/text_rows.h"
#include "scene/scene.h"

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
      better = trial_residual < residual;
      if (!better) continue;
      q = trial;
      at = trial_at;
      residual = trial_residual;
      std::copy(std::begin(trial_j), std::end(trial_j), j);
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
  for (int i = 1; i <= 32; ++i)
    if (!(radial_slope(c, end * i / 32) > 0)) return false;
  return true;
}

bool undistort(const Camera& c, Plane target, Plane& out) {
  out = target;
  if (newton(c, target, out) && inside_first_fold(c, squared(out))) return true;
  // Strong lenses: walk from the axis outwards, each solution starting the next one.
  out = {};
  for (int i = 1; i <= 16; ++i)
    if (!newton(c, {target.x * i / 16, target.y * i / 16}, out)) return false;
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

namespace {

using Matrix = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

Eigen::Map<Matrix> matrix_of(Pose& pose) { return Eigen::Map<Matrix>(pose.r[0].data()); }

}  // namespace

void make_rotation(Pose& pose) {
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(matrix_of(pose), Eigen::ComputeFullU | Eigen::ComputeFullV);
  const Eigen::Matrix3d near = svd.matrixU() * svd.matrixV().transpose();
  // The factors are orthonormal to about 4e-15; a step of Newton's iteration (Higham 1986) leaves less than 1e-15.
  matrix_of(pose) = 0.5 * near * (3 * Eigen::Matrix3d::Identity() - near.transpose() * near);
}

Quaternion quaternion_of(const Pose& pose) {
  const Eigen::Quaterniond q(Eigen::Matrix3d(Eigen::Map<const Matrix>(pose.r[0].data())));
  return {q.w(), q.x(), q.y(), q.z()};
}

void set_rotation(Pose& pose, const Quaternion& turn) {
  Eigen::Quaterniond q(turn[0], turn[1], turn[2], turn[3]);
  q.coeffs() /= q.norm();  // normalized() would leave a zero one as it is
  matrix_of(pose) = q.toRotationMatrix();
}

// Cameras as JSON.

namespace {

using Json = nlohmann::ordered_json;

constexpr const char* kFormat = "semfield-cameras-1";
constexpr const char* kAlongRay = "distance along the ray";
constexpr const char* kZDepth = "z-depth";

// Numbers of a camera; its file may leave out those behind the first four.
constexpr std::size_t kNeeded = 4;
using C = Camera;
constexpr std::array<std::pair<const char*, double Camera::*>, 10> kNumbers{{{"fx", &C::fx},
                                                                             {"fy", &C::fy},
                                                                             {"cx", &C::cx},
                                                                             {"cy", &C::cy},
                                                                             {"k1", &C::k1},
                                                                             {"k2", &C::k2},
                                                                             {"k3", &C::k3},
                                                                             {"k4", &C::k4},
                                                                             {"p1", &C::p1},
                                                                             {"p2", &C::p2}}};

// By LensKind, as the key "lens" names them; a perspective camera needs none.
constexpr std::array kKinds{"perspective", "fisheye", "equirectangular"};

Json json_of(const PlacedCamera& placed) {
  const Camera& c = placed.camera;
  Json out{{"name", placed.name}, {"width", c.width_px}, {"height", c.height_px}};
  if (c.is_wide()) out["lens"] = kKinds[static_cast<std::size_t>(c.lens)];
  for (const auto& [key, member] : kNumbers) out[key] = c.*member;
  if (placed.far_m > 0) {
    out["near"] = placed.near_m;
    out["far"] = placed.far_m;
  }
  const auto& [r, t] = placed.world_from_camera;
  out["world_from_camera"] = {{r[0][0], r[0][1], r[0][2], t.x},
                              {r[1][0], r[1][1], r[1][2], t.y},
                              {r[2][0], r[2][1], r[2][2], t.z},
                              {0, 0, 0, 1}};
  return out;
}

[[noreturn]] void refuse(const std::string& path, const std::string& what) {
  throw Error(
      ErrorKind::data, "render.cameras.format", path + ": " + what,
      "give a cameras.json as `semfield render` writes it, or a text file with a camera-to-world matrix per line");
}

// One camera of a file; nothing where something of it is wrong, which goes to the diagnostics.
std::optional<PlacedCamera> read_camera(const Json& node, const std::string& place, Diagnostics& diagnostics) {
  const int before = diagnostics.error_count();
  const auto error = [&](const std::string& what, const std::string& remedy) {
    diagnostics.error("render.cameras.entry", place, what, remedy);
  };
  const auto number = [&](const char* key, std::optional<double> otherwise = std::nullopt) {
    if (!node.contains(key) && otherwise) return *otherwise;
    if (node.contains(key) && node[key].is_number()) return node[key].get<double>();
    error(std::string("'") + key + (node.contains(key) ? "' is not a number" : "' is missing"), "write a number");
    return 0.0;
  };
  if (!node.is_object()) {
    error("is not an object of keys and values", "write {\"name\": ..., \"width\": ..., ...}");
    return std::nullopt;
  }
  std::vector<std::string> known{"name", "width", "height"};
  for (const auto& [key, member] : kNumbers) known.emplace_back(key);
  known.insert(known.end(), {"lens", "near", "far", "world_from_camera"});
  for (const auto& [key, value] : node.items()) {
    if (std::find(known.begin(), known.end(), key) != known.end()) continue;
    error("unknown key '" + key + "'", near_name_remedy(key, known, "known: " + join(known)));
  }
  PlacedCamera out;
  Camera& c = out.camera;
  if (node.contains("name") && node["name"].is_string())
    out.name = node["name"].get<std::string>();
  else
    error("'name' is not text", "name its images, such as \"name\": \"00001\"");
  const double width = number("width"), height = number("height");
  for (std::size_t i = 0; i < kNumbers.size(); ++i)
    c.*kNumbers[i].second = number(kNumbers[i].first, i < kNeeded ? std::nullopt : std::optional(0.0));
  if (node.contains("lens")) {
    const auto kind = std::find(kKinds.begin(), kKinds.end(), node["lens"]) - kKinds.begin();
    if (kind == std::ssize(kKinds))
      error("'lens' is none of perspective, fisheye and equirectangular", "write one of these, or leave it out");
    else
      c.lens = static_cast<LensKind>(kind);
  }
  std::vector<double> rows;
  const Json matrix = node.value("world_from_camera", Json());
  for (std::size_t i = 0; i < 16 && matrix.is_array() && matrix.size() == 4; ++i) {
    const Json& row = matrix[i / 4];
    if (row.is_array() && row.size() == 4 && row[i % 4].is_number()) rows.push_back(row[i % 4].get<double>());
  }
  if (rows.size() != 16)
    error("'world_from_camera' is not a list of 4 rows of 4 numbers", "write [[1, 0, 0, 0], [0, 1, 0, 0], ...]");
  if (diagnostics.error_count() > before) return std::nullopt;
  const auto whole = [](double v) { return v >= 1 && v <= 2147483647.0 && v == std::floor(v); };
  if (!whole(width) || !whole(height)) {
    error("'width' x 'height' is not a pair of whole numbers of pixels", "write the size of the image");
    return std::nullopt;
  }
  try {
    check_image_limits(static_cast<std::int64_t>(width), static_cast<std::int64_t>(height), 3);
  } catch (const Error& e) {
    error(e.message(), e.remedy());
    return std::nullopt;
  }
  c.width_px = static_cast<std::int32_t>(width);
  c.height_px = static_cast<std::int32_t>(height);
  if (!check_camera(c, place, diagnostics) || !check_last_row(rows, place, diagnostics)) return std::nullopt;
  out.world_from_camera = pose_from_rows(rows);
  if (check_pose(out.world_from_camera, place, diagnostics) == PoseState::not_finite)
    error("'world_from_camera' is not finite", "leave the camera out");
  if (node.contains("near") || node.contains("far")) {
    out.near_m = number("near");
    out.far_m = number("far");
    if (!(out.near_m >= 0) || !(out.near_m < out.far_m) || !std::isfinite(out.far_m))
      error("'near' and 'far' are not distances with 0 <= near < far", "correct them, or leave both out");
  }
  return diagnostics.error_count() > before ? std::nullopt : std::optional(out);
}

}  // namespace

void write_cameras(const std::string& path, const CameraSet& set) {
  std::string text = fmt::format(
      "{{\n\"format\": \"{}\",\n\"axes\": \"OpenCV: x right, y down, z forward\",\n\"near_far\": "
      "\"{}\",\n{}\"cameras\": "
      "[\n",
      kFormat, set.z_depth ? kZDepth : kAlongRay,
      set.depth_step > 0 ? fmt::format("\"depth_step\": {},\n", set.depth_step) : "");
  for (std::size_t i = 0; i < set.cameras.size(); ++i) {
    text += json_of(set.cameras[i]).dump(-1, ' ', false, Json::error_handler_t::replace);
    text += i + 1 < set.cameras.size() ? ",\n" : "\n";
  }
  write_file_atomic(path, text + "]\n}\n");
}

bool is_camera_set(const std::string& path) {
  const std::string start = read_file_start(path, 4096);
  const std::size_t first = start.find_first_not_of(" \t\r\n");
  return first != std::string::npos && (start[first] == '{' || start[first] == '[');
}

CameraSet read_cameras(const std::string& path, Diagnostics& diagnostics) {
  Json root;
  try {
    root = Json::parse(read_pose_file(path));
  } catch (const Json::exception& e) {
    refuse(path, "not valid JSON: " + json_cause(e.what()));
  }
  if (!root.is_object() || !root.contains("format") || root["format"] != kFormat)
    refuse(path, fmt::format("its 'format' is not '{}'", kFormat));
  if (!root.contains("cameras") || !root["cameras"].is_array() || root["cameras"].empty())
    refuse(path, "it has no list 'cameras' with a camera in it");
  check_input_limit(std::ssize(root["cameras"]), input_limits().frames, path + ": ", "cameras", "frames");
  CameraSet set;
  if (root.contains("near_far")) {
    set.z_depth = root["near_far"] == kZDepth;
    if (!set.z_depth && root["near_far"] != kAlongRay)
      refuse(path, fmt::format("its 'near_far' is neither '{}' nor '{}'", kAlongRay, kZDepth));
  }
  OutputNames names;
  for (std::size_t i = 0; i < root["cameras"].size(); ++i) {
    const std::string place = fmt::format("{}: camera {}", path, i);
    std::optional<PlacedCamera> camera = read_camera(root["cameras"][i], place, diagnostics);
    if (!camera) continue;
    if (const auto wrong = names.add(camera->name))
      diagnostics.error("scene.frame.name", place, *wrong, kFrameNameRemedy);
    set.cameras.push_back(std::move(*camera));
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the cameras have problems:");
  return set;
}

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
  for (int row = 0; row < 3; ++row) pose.r[static_cast<std::size_t>(row)] = {x[row], y[row], z[row]};
  pose.t = position;
  return pose;
}

namespace {

Pose pose_of(const std::vector<double>& m, const std::string& where, CameraAxes axes) {
  Pose pose = pose_from_rows(m);
  const Vec3d x = pose.axis(0), y = pose.axis(1), z = pose.axis(2);
  const double off = std::max({std::abs(dot(x, y)), std::abs(dot(y, z)), std::abs(dot(x, z)), std::abs(length(x) - 1),
                               std::abs(length(y) - 1), std::abs(length(z) - 1)});
  if (!(off < 1e-3) || dot(cross(x, y), z) < 0)
    throw Error(ErrorKind::data, "render.path.pose", where + ": the 3x3 part is not a rotation",
                "give camera-to-world matrices");
  if (m.size() == 16 && (m[12] != 0 || m[13] != 0 || m[14] != 0 || m[15] != 1))
    throw Error(ErrorKind::data, "render.path.pose", where + ": the last row is not 0 0 0 1",
                "give camera-to-world matrices, row by row");
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
  std::vector<std::string> places;
  std::string line;
  for (int number = 1; std::getline(stream, line); ++number) {
    const std::string place = path + ":" + std::to_string(number);
    const auto first = line.find_first_not_of(" \t\r");
    if (first == std::string::npos || line[first] == '#') continue;
    std::vector<double> row;
    for (const std::string_view word : words_of(line)) {
      double value = 0;
      const char* begin = word.data() + (word.size() > 1 && word[0] == '+' ? 1 : 0);
      const auto [end, code] = std::from_chars(begin, word.data() + word.size(), value);
      const bool tiny = code == std::errc::result_out_of_range && word.find("e-") != std::string_view::npos;
      if (end != word.data() + word.size() || !(code == std::errc{} || tiny) || !std::isfinite(value))
        throw Error(ErrorKind::data, "render.path.number",
                    fmt::format("{}: '{}' is not a finite number", place, word.substr(0, 40)),
                    "write finite numbers, and leave out poses that are lost");
      row.push_back(tiny ? 0 : value);
    }
    if (row.size() != 16 && row.size() != 12 && row.size() != 4)
      throw Error(ErrorKind::data, "render.path.format",
                  fmt::format("{}: expected 4, 12 or 16 numbers, got '{}'", place, line.substr(0, 80)),
                  "write one camera-to-world matrix per line, or one matrix row per line");
    rows.push_back(std::move(row));
    places.push_back(place);
  }
  if (rows.empty())
    throw Error(ErrorKind::data, "render.path.empty", path + ": holds no pose",
                "write one camera-to-world matrix per line");
  std::size_t per_pose = 1;
  if (rows[0].size() == 4) per_pose = rows.size() >= 4 && rows[3] == std::vector<double>{0, 0, 0, 1} ? 4 : 3;
  if (rows.size() % per_pose != 0)
    throw Error(ErrorKind::data, "render.path.format",
                fmt::format("{}: {} lines are not a multiple of {}", path, rows.size(), per_pose),
                "the file was cut short");
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < rows.size(); i += per_pose) {
    std::vector<double> m;
    for (std::size_t k = 0; k < per_pose; ++k) m.insert(m.end(), rows[i + k].begin(), rows[i + k].end());
    if (m.size() != 12 && m.size() != 16)
      throw Error(ErrorKind::data, "render.path.format", places[i] + ": expected 12 or 16 numbers per pose",
                  "write all poses of a file in the same form");
    poses.push_back(pose_of(m, places[i], axes));
  }
  return poses;
}

}  // namespace semfield
