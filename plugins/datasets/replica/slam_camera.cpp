// cam_params.json: {"camera": {"w": 1200, "h": 680, "fx": 600, "fy": 600, "cx": 599.5, "cy": 339.5, "scale": 6553.5}}
#include "datasets/replica/slam_camera.h"

#include <filesystem>
#include <nlohmann/json.hpp>

#include "loading/json_file.h"
#include "loading/posed_photographs.h"

namespace semfield {

namespace fs = std::filesystem;
using nlohmann::json;

bool is_slam_sequence(const std::string& folder) {
  std::error_code unknown;
  return fs::is_regular_file(fs::path(folder) / "traj.txt", unknown) &&
         fs::is_directory(fs::path(folder) / "results", unknown);
}

SlamCamera read_slam_camera(const std::string& folder, Diagnostics& diagnostics) {
  constexpr const char* kFile = "cam_params.json";
  const fs::path beside = fs::path(folder) / kFile, above = fs::weakly_canonical(folder).parent_path() / kFile;
  std::error_code unknown;
  const std::string path = (fs::exists(beside, unknown) ? beside : above).string();
  if (!fs::exists(path, unknown)) return {};
  const json root = read_pose_json<json>(path, "download the scene again");
  bool sound = true;
  const auto number = [&](const char* key) {
    const bool there = root.is_object() && root.contains("camera") && root["camera"].is_object() &&
                       root["camera"].contains(key) && root["camera"][key].is_number();
    if (there) return root["camera"][key].get<double>();
    if (sound)
      diagnostics.error("scene.index.value", path, std::string("has no number '") + key + "' in 'camera'",
                        "download the scene again");
    sound = false;
    return 0.0;
  };
  SlamCamera out;
  Camera camera;
  const double width = number("w"), height = number("h"), steps = number("scale");
  camera.fx = number("fx");
  camera.fy = number("fy");
  camera.cx = number("cx") + 0.5;  // centres of pixels are whole numbers there
  camera.cy = number("cy") + 0.5;
  if (!sound || !set_image_size(camera, width, height, path, diagnostics)) return out;
  if (!(steps >= 1e-6 && steps <= 1e9)) {
    diagnostics.error("scene.index.value", path, "'scale' is not a number of steps per metre",
                      "write the steps of a depth image per metre, such as 6553.5");
    return out;
  }
  out.camera = camera;
  out.depth_unit_m = 1 / steps;
  return out;
}

}  // namespace semfield
