// Cameras as JSON.
#include "scene/camera_set.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>
#include <optional>

#include "core/text.h"
#include "formats/input_limits.h"
#include "scene/output_names.h"
#include "scene/scene_checks.h"
#include "system/files.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

constexpr const char* kFormat = "semfield-cameras-1";
constexpr const char* kAlongRay = "distance along the ray";
constexpr const char* kZDepth = "z-depth";

// Numbers of a camera that its file may leave out.
constexpr std::array<std::pair<const char*, double Camera::*>, 6> kLens{{{"k1", &Camera::k1},
                                                                         {"k2", &Camera::k2},
                                                                         {"k3", &Camera::k3},
                                                                         {"k4", &Camera::k4},
                                                                         {"p1", &Camera::p1},
                                                                         {"p2", &Camera::p2}}};
constexpr std::array<std::pair<const char*, double Camera::*>, 4> kPinhole{
    {{"fx", &Camera::fx}, {"fy", &Camera::fy}, {"cx", &Camera::cx}, {"cy", &Camera::cy}}};

// As the key "lens" names them; a perspective camera needs none.
constexpr std::array<std::pair<const char*, LensKind>, 3> kKinds{{{"perspective", LensKind::perspective},
                                                                  {"fisheye", LensKind::fisheye},
                                                                  {"equirectangular", LensKind::equirectangular}}};

Json json_of(const PlacedCamera& placed) {
  const Camera& c = placed.camera;
  Json out{{"name", placed.name}, {"width", c.width_px}, {"height", c.height_px}};
  if (c.is_wide()) out["lens"] = kKinds[static_cast<std::size_t>(c.lens)].first;
  for (const auto& [key, member] : kPinhole) out[key] = c.*member;
  for (const auto& [key, member] : kLens) out[key] = c.*member;
  if (placed.far_m > 0) {
    out["near"] = placed.near_m;
    out["far"] = placed.far_m;
  }
  Json& matrix = out["world_from_camera"] = Json::array();
  for (int row = 0; row < 3; ++row) {
    const auto& r = placed.world_from_camera.r[static_cast<std::size_t>(row)];
    matrix.push_back({r[0], r[1], r[2], placed.world_from_camera.t[row]});
  }
  matrix.push_back({0, 0, 0, 1});
  return out;
}

[[noreturn]] void refuse(const std::string& path, const std::string& what) {
  throw Error(
      ErrorKind::data, "render.cameras.format", path + ": " + what,
      "give a cameras.json as `semfield render` writes it, or a text file with a camera-to-world matrix a line");
}

// One camera of a file; what is wrong with it goes to the diagnostics.
class CameraReader {
 public:
  CameraReader(const Json& node, std::string place, Diagnostics& diagnostics)
      : node_(node), place_(std::move(place)), diagnostics_(diagnostics) {}

  std::optional<PlacedCamera> read() {
    const int before = diagnostics_.error_count();
    if (!node_.is_object()) {
      error("is not an object of keys and values", "write {\"name\": ..., \"width\": ..., ...}");
      return std::nullopt;
    }
    check_keys();
    PlacedCamera out;
    out.name = name();
    Camera& c = out.camera;
    const double width = number("width"), height = number("height");
    for (const auto& [key, member] : kPinhole) c.*member = number(key);
    for (const auto& [key, member] : kLens) c.*member = number(key, 0);
    c.lens = lens();
    const std::vector<double> rows = matrix();
    if (diagnostics_.error_count() > before) return std::nullopt;
    if (!set_size(c, width, height) || !check_camera(c, place_, diagnostics_)) return std::nullopt;
    if (!check_last_row(rows, place_, diagnostics_)) return std::nullopt;
    out.world_from_camera = pose_from_rows(rows);
    if (check_pose(out.world_from_camera, place_, diagnostics_) == PoseState::not_finite)
      error("'world_from_camera' is not finite", "leave the camera out");
    read_limits(out);
    if (diagnostics_.error_count() > before) return std::nullopt;
    return out;
  }

 private:
  void error(const std::string& what, const std::string& remedy) {
    diagnostics_.error("render.cameras.entry", place_, what, remedy);
  }

  void check_keys() {
    std::vector<std::string> known{"name", "width", "height"};
    for (const auto& [key, member] : kPinhole) known.emplace_back(key);
    for (const auto& [key, member] : kLens) known.emplace_back(key);
    known.insert(known.end(), {"lens", "near", "far", "world_from_camera"});
    for (const auto& [key, value] : node_.items()) {
      if (std::find(known.begin(), known.end(), key) != known.end()) continue;
      const std::string near = did_you_mean(key, known);
      error("unknown key '" + key + "'", near.empty() ? "known: " + join(known) : "did you mean '" + near + "'?");
    }
  }

  std::string name() {
    if (!node_.contains("name") || !node_["name"].is_string()) {
      error("'name' is not text", "name its images, such as \"name\": \"00001\"");
      return {};
    }
    return node_["name"].get<std::string>();
  }

  LensKind lens() {
    if (!node_.contains("lens")) return LensKind::perspective;
    for (const auto& [name, kind] : kKinds)
      if (node_["lens"] == name) return kind;
    error("'lens' is none of perspective, fisheye and equirectangular", "write one of these, or leave it out");
    return LensKind::perspective;
  }

  double number(const char* key, std::optional<double> otherwise = std::nullopt) {
    if (!node_.contains(key) && otherwise) return *otherwise;
    if (node_.contains(key) && node_[key].is_number()) return node_[key].get<double>();
    error(std::string("'") + key + (node_.contains(key) ? "' is not a number" : "' is missing"), "write a number");
    return 0;
  }

  std::vector<double> matrix() {
    std::vector<double> rows;
    const Json* const matrix = node_.contains("world_from_camera") ? &node_["world_from_camera"] : nullptr;
    for (std::size_t r = 0; matrix != nullptr && matrix->is_array() && matrix->size() == 4 && r < 4; ++r) {
      const Json& row = (*matrix)[r];
      for (std::size_t c = 0; row.is_array() && row.size() == 4 && c < 4; ++c) {
        if (row[c].is_number()) rows.push_back(row[c].get<double>());
      }
    }
    if (rows.size() != 16)
      error("'world_from_camera' is not a list of 4 rows of 4 numbers", "write [[1, 0, 0, 0], [0, 1, 0, 0], ...]");
    return rows;
  }

  bool set_size(Camera& c, double width, double height) {
    const auto whole = [](double v) { return v >= 1 && v <= 2147483647.0 && v == std::floor(v); };
    if (!whole(width) || !whole(height)) {
      error("'width' x 'height' is not a pair of whole numbers of pixels", "write the size of the image");
      return false;
    }
    try {
      check_image_limits(static_cast<std::int64_t>(width), static_cast<std::int64_t>(height), 3);
    } catch (const Error& e) {
      error(e.message(), e.remedy());
      return false;
    }
    c.width_px = static_cast<std::int32_t>(width);
    c.height_px = static_cast<std::int32_t>(height);
    return true;
  }

  void read_limits(PlacedCamera& out) {
    if (!node_.contains("near") && !node_.contains("far")) return;
    out.near_m = number("near");
    out.far_m = number("far");
    if (!(out.near_m >= 0) || !(out.near_m < out.far_m) || !std::isfinite(out.far_m))
      error("'near' and 'far' are not distances with 0 <= near < far", "correct them, or leave both out");
  }

  const Json& node_;
  std::string place_;
  Diagnostics& diagnostics_;
};

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
    std::optional<PlacedCamera> camera = CameraReader(root["cameras"][i], place, diagnostics).read();
    if (!camera) continue;
    if (const auto wrong = names.add(camera->name))
      diagnostics.error("scene.frame.name", place, *wrong, kFrameNameRemedy);
    set.cameras.push_back(std::move(*camera));
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the cameras have problems:");
  return set;
}

}  // namespace semfield
