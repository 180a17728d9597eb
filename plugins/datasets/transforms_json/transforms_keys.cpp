#include "datasets/transforms_json/transforms_keys.h"

#include <algorithm>
#include <map>
#include <vector>

#include "core/spelling.h"

namespace semfield {

namespace {

const std::vector<std::string> kLensKeys{"w",
                                         "h",
                                         "fl_x",
                                         "fl_y",
                                         "cx",
                                         "cy",
                                         "camera_angle_x",
                                         "camera_angle_y",
                                         "k1",
                                         "k2",
                                         "k3",
                                         "k4",
                                         "p1",
                                         "p2",
                                         "camera_model",
                                         "is_fisheye",
                                         "distortion_params",
                                         "K",
                                         "intrinsics",
                                         "intrinsic_matrix",
                                         "camera_matrix",
                                         "cam_K"};
const std::vector<std::string> kFileKeys{
    "frames",     "classes", "depth_unit_m", "train_filenames",     "test_filenames",          "val_filenames",
    "aabb_scale", "scale",   "offset",       "integer_depth_scale", "depth_unit_scale_factor", "depth_camera"};
const std::vector<std::string> kFrameKeys{
    "file_path", "depth_path",       "label_path",   "instance_path",       "depth_file_path",
    "mask_path", "transform_matrix", "depth_unit_m", "integer_depth_scale", "depth_unit_scale_factor"};

// What other programs, and people, call the keys.
const std::map<std::string, std::string> kOtherNames{{"fx", "fl_x"},
                                                     {"fy", "fl_y"},
                                                     {"focal", "fl_x"},
                                                     {"focal_length", "fl_x"},
                                                     {"width", "w"},
                                                     {"height", "h"},
                                                     {"c_x", "cx"},
                                                     {"c_y", "cy"},
                                                     {"image", "file_path"},
                                                     {"image_path", "file_path"},
                                                     {"filename", "file_path"},
                                                     {"file_name", "file_path"},
                                                     {"pose", "transform_matrix"},
                                                     {"matrix", "transform_matrix"},
                                                     {"c2w", "transform_matrix"},
                                                     {"transform", "transform_matrix"},
                                                     {"camera_to_world", "transform_matrix"}};

// Keys of nerfstudio, instant-ngp and Blender that are near one of ours.
const std::vector<std::string> kStrangers{"frame_id", "filenames", "depth_unit"};

std::string meant_key(const std::string& key, bool of_frame, const std::vector<std::string>& named) {
  std::vector<std::string> known = kLensKeys;
  const std::vector<std::string>& own = of_frame ? kFrameKeys : kFileKeys;
  known.insert(known.end(), own.begin(), own.end());
  if (of_frame) known.insert(known.end(), named.begin(), named.end());
  const auto is_in = [&key](const std::vector<std::string>& list) {
    return std::find(list.begin(), list.end(), key) != list.end();
  };
  if (is_in(known) || is_in(kStrangers)) return "";
  if (const auto other = kOtherNames.find(key); other != kOtherNames.end()) {
    const bool here = std::find(known.begin(), known.end(), other->second) != known.end();
    return here ? other->second : "";
  }
  for (const char* end : {"_path", "_file_path", "_matrix"}) {
    if (std::find(own.begin(), own.end(), key + end) != own.end()) return key + end;
  }
  return key.size() < 4 ? "" : closest_spelling(key, known);
}

}  // namespace

const std::string& TransformsKeys::meant_by(const std::string& key, bool of_frame) {
  const auto [found, fresh] = meant_[of_frame ? 1 : 0].try_emplace(key);
  if (fresh) found->second = meant_key(key, of_frame, named_);
  return found->second;
}

void TransformsKeys::look_for_map(const std::string& key, const std::string& file) {
  const std::string end = "_path";
  const auto among = [&](const std::vector<std::string>& keys) {
    return std::find(keys.begin(), keys.end(), key) != keys.end();
  };
  const bool known = among(kFrameKeys) || among(named_);
  if (!known && key.ends_with(end) && file.ends_with(".npy"))
    unread_maps_.insert(key.substr(0, key.size() - end.size()));
}

}  // namespace semfield
