// What keys of transforms.json hold: numbers, flags, lenses and the unit of depth.
#pragma once

#include <algorithm>
#include <array>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "datasets/transforms_json/transforms_index.h"

namespace semfield {

/// Reads values of a file or of one of its frames; what is wrong goes into the diagnostics under `place`. `Json` is a
/// type of nlohmann-json, which no header names.
template <class Json>
class TransformsValues {
 public:
  explicit TransformsValues(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}

  std::optional<double> number(const Json& node, const char* key, const std::string& place) {
    if (!node.contains(key) || node[key].is_null()) return std::nullopt;
    if (!node[key].is_number()) {
      diagnostics_.error("scene.index.value", place, std::string("'") + key + "' is not a number", "write a number");
      return std::nullopt;
    }
    return node[key].template get<double>();
  }

  // nerfstudio writes a flag, instant-ngp 0 or 1, and hand-made files "true". Nothing when reported.
  std::optional<bool> flag(const Json& node, const char* key, const std::string& place) {
    if (!node.contains(key) || node[key].is_null()) return false;
    const Json& value = node[key];
    if (value.is_boolean()) return value.template get<bool>();
    for (const auto& [means, as_written] :
         {std::pair{true, Json{1, "true", "True", "1"}}, std::pair{false, Json{0, "false", "False", "0", ""}}}) {
      if (std::find(as_written.begin(), as_written.end(), value) != as_written.end()) return means;
    }
    diagnostics_.error("scene.index.value", place,
                       std::string("'") + key + "' is " + value.dump() + ", neither true nor false",
                       "write true or false");
    return std::nullopt;
  }

  // The lens of a file or of one of its frames, which may leave it to the file; nothing when reported.
  std::optional<LensKind> model(const Json& node, LensKind otherwise, const std::string& place) {
    std::string model;
    if (node.contains("camera_model") && !node["camera_model"].is_null()) {
      if (!node["camera_model"].is_string()) {
        diagnostics_.error("scene.index.value", place,
                           "'camera_model' is " + node["camera_model"].dump() + ", which is not a name",
                           "write \"camera_model\": \"OPENCV\", or leave the key out");
        return std::nullopt;
      }
      model = node["camera_model"].template get<std::string>();
    }
    const std::optional<bool> fisheye = flag(node, "is_fisheye", place);
    if (!fisheye) return std::nullopt;
    if (*fisheye) model = "OPENCV_FISHEYE";
    if (model.empty()) return otherwise;
    static const std::map<std::string, LensKind> known{
        {"OPENCV", LensKind::perspective},         {"PINHOLE", LensKind::perspective},
        {"SIMPLE_PINHOLE", LensKind::perspective}, {"SIMPLE_RADIAL", LensKind::perspective},
        {"RADIAL", LensKind::perspective},         {"PERSPECTIVE", LensKind::perspective},
        {"OPENCV_FISHEYE", LensKind::fisheye},     {"EQUIRECTANGULAR", LensKind::equirectangular}};
    if (const auto found = known.find(model); found != known.end()) return found->second;
    diagnostics_.error(
        "scene.camera.model", place,
        "camera model '" + model +
            "' is not supported (only OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE, "
            "EQUIRECTANGULAR)",
        "undistort the images to a pinhole camera, for example with colmap image_undistorter");
    return std::nullopt;
  }

  TransformsLens lens(const Json& node, const TransformsLens& base, const std::string& place) {
    TransformsLens out = base;
    const std::pair<const char*, double*> fields[] = {{"w", &out.w},
                                                      {"h", &out.h},
                                                      {"fl_x", &out.fl_x},
                                                      {"fl_y", &out.fl_y},
                                                      {"camera_angle_x", &out.camera_angle_x},
                                                      {"camera_angle_y", &out.camera_angle_y},
                                                      {"k1", &out.k1},
                                                      {"k2", &out.k2},
                                                      {"k3", &out.k3},
                                                      {"k4", &out.k4},
                                                      {"p1", &out.p1},
                                                      {"p2", &out.p2}};
    for (const auto& [key, field] : fields) {
      if (const auto value = number(node, key, place)) *field = *value;
    }
    if (const auto value = number(node, "cx", place)) out.cx = value;
    if (const auto value = number(node, "cy", place)) out.cy = value;
    read_distortion(node, out, place);
    read_camera_matrix(node, out, place);
    return out;
  }

  /// Metres of one step of a depth image: `otherwise` where no key says; 0 = not told.
  double depth_unit(const Json& node, double otherwise, const std::string& place) {
    // Ours, instant-ngp's and nerfstudio's. What other names mean is not clear: steps per metre, or metres per step.
    constexpr std::array kKeys{"depth_unit_m", "integer_depth_scale", "depth_unit_scale_factor"};
    for (const char* key : {"depth_scale", "depth_scale_factor", "depth_factor", "depth_unit", "png_depth_scale"})
      if (node.contains(key) && unclear_depth_key_.empty()) unclear_depth_key_ = key;
    const char* from = nullptr;
    double unit = otherwise;
    for (const char* key : kKeys) {
      const std::optional<double> value = number(node, key, place);
      if (!value || *value == 0) continue;
      if (!(*value >= 1e-9 && *value <= 1e6)) {
        diagnostics_.error("scene.index.value", place, std::string(key) + " must be positive, from 1e-9 to 1e6",
                           "write the metres of one step, such as 0.001");
      } else if (from != nullptr && *value != unit) {
        diagnostics_.error("scene.index.value", place,
                           std::string("'") + key + "' is not what '" + from + "' says of the unit of depth",
                           "keep one of the two");
      } else {
        from = key;
        unit = *value;
      }
    }
    return unit;
  }
  /// A key met that seems to tell the unit of depth, of which it is not clear how; "" for none.
  const std::string& unclear_depth_key() const { return unclear_depth_key_; }

 private:
  // nerfstudio's list of all coefficients, which takes the place of the single keys there.
  void read_distortion(const Json& node, TransformsLens& lens, const std::string& place) {
    if (!node.contains("distortion_params") || node["distortion_params"].is_null()) return;
    const Json& list = node["distortion_params"];
    const std::pair<const char*, double*> fields[] = {{"k1", &lens.k1}, {"k2", &lens.k2}, {"k3", &lens.k3},
                                                      {"k4", &lens.k4}, {"p1", &lens.p1}, {"p2", &lens.p2}};
    if (!list.is_array() || list.size() != std::size(fields) ||
        !std::all_of(list.begin(), list.end(), [](const Json& v) { return v.is_number(); })) {
      diagnostics_.error("scene.index.value", place, "'distortion_params' is not a list of six numbers",
                         "write [k1, k2, k3, k4, p1, p2]");
      return;
    }
    for (std::size_t i = 0; i < std::size(fields); ++i) {
      const auto& [key, field] = fields[i];
      const double value = list[i].template get<double>();
      if (node.contains(key) && node[key].is_number() && node[key].template get<double>() != value) {
        diagnostics_.error("scene.index.value", place,
                           std::string("'") + key + "' is not what 'distortion_params' has in its place",
                           "keep one of the two");
        return;
      }
      *field = value;
    }
  }

  // The numbers of a 3 x 3, 3 x 4 or 4 x 4 matrix, of its rows or all in one list; the first three of its first three
  // rows.
  static std::optional<std::array<double, 9>> matrix_of(const Json& value) {
    std::vector<double> all;
    std::size_t rows = 0;
    if (!value.is_array()) return std::nullopt;
    for (const Json& row : value) {
      rows += row.is_array() ? 1 : 0;
      for (const Json& one : row.is_array() ? row : Json::array({row})) {
        if (!one.is_number()) return std::nullopt;
        all.push_back(one.template get<double>());
      }
    }
    const std::size_t columns = all.size() == 9 ? 3 : all.size() == 12 || all.size() == 16 ? 4 : 0;
    if (columns == 0 || (rows != 0 && rows != all.size() / columns)) return std::nullopt;
    std::array<double, 9> out{};
    for (std::size_t i = 0; i < 9; ++i) out[i] = all[i / 3 * columns + i % 3];
    return out;
  }

  // A lens as the matrix of a pinhole camera, row by row or transposed.
  void read_camera_matrix(const Json& node, TransformsLens& lens, const std::string& place) {
    for (const char* key : {"K", "intrinsics", "intrinsic_matrix", "camera_matrix", "cam_K"}) {
      if (!node.contains(key) || node[key].is_null()) continue;
      const std::optional<std::array<double, 9>> found = matrix_of(node[key]);
      std::array<double, 9> k = found.value_or(std::array<double, 9>{});
      if (k[2] == 0 && k[5] == 0) {
        std::swap(k[1], k[3]);
        std::swap(k[2], k[6]);
        std::swap(k[5], k[7]);
      }
      if (!found || k[1] != 0 || k[3] != 0 || k[6] != 0 || k[7] != 0 || k[8] != 1) {
        if (lens.fl_x != 0 || lens.camera_angle_x != 0) continue;  // something else of that name
        diagnostics_.error("scene.camera.format", place,
                           std::string("'") + key + "' is not the matrix of a pinhole camera without skew",
                           "write 'fl_x', 'fl_y', 'cx' and 'cy', or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]");
        return;
      }
      const std::pair<const char*, double> same[] = {{"fl_x", k[0]}, {"fl_y", k[4]}, {"cx", k[2]}, {"cy", k[5]}};
      for (const auto& [name, value] : same) {
        if (!node.contains(name) || !node[name].is_number() || node[name].template get<double>() == value) continue;
        diagnostics_.error("scene.index.value", place,
                           std::string("'") + name + "' is not what '" + key + "' has in its place",
                           "keep one of the two");
        return;
      }
      lens.fl_x = k[0];
      lens.fl_y = k[4];
      lens.cx = k[2];
      lens.cy = k[5];
      return;
    }
  }

  Diagnostics& diagnostics_;
  std::string unclear_depth_key_;
};

}  // namespace semfield
