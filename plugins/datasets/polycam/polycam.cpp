// Raw exports of Polycam from a phone with LiDAR: keyframes/ with images, cameras, depth and confidence.
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "plugin/module.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

using nlohmann::json;

struct PolycamParams : PhotographParams {};

namespace {

// Those that the app undistorted and optimised, where it did.
bool is_corrected(const fs::path& keyframes) {
  return is_folder(keyframes / "corrected_cameras") && is_folder(keyframes / "corrected_images");
}

// False when reported.
bool read_camera(const std::string& path, PosedPhotograph& photo, Diagnostics& diagnostics) {
  json root;
  try {
    root = read_pose_json<json>(path, "export the capture again");
  } catch (const Error& e) {
    const bool missing = e.kind() == ErrorKind::no_input;
    diagnostics.error(missing ? Code("scene.pose.missing") : e.code(), "'" + photo.color + "'", e.message(),
                      missing ? "export the capture again, or remove the image" : e.remedy());
    return false;
  }
  bool sound = true;
  const auto number = [&](const std::string& key) {
    if (root.is_object() && root.contains(key) && root[key].is_number()) return root[key].get<double>();
    if (sound) diagnostics.error("scene.index.value", path, "has no number '" + key + "'", "export the capture again");
    sound = false;
    return 0.0;
  };
  std::vector<double> rows;
  for (const char row : {'0', '1', '2'})
    for (const char column : {'0', '1', '2', '3'}) rows.push_back(number(std::string("t_") + row + column));
  Camera& c = photo.camera;
  const double width = number("width"), height = number("height");
  c.fx = number("fx");
  c.fy = number("fy");
  c.cx = number("cx");
  c.cy = number("cy");
  photo.world_from_camera = opencv_from_opengl(pose_from_rows(rows));
  return sound && set_image_size(c, width, height, path, diagnostics);
}

}  // namespace

std::string recognise(const std::string& path, PolycamParams& p) {
  for (const fs::path& root : {fs::path(path), fs::path(path).parent_path()}) {
    if (!is_folder(root / "keyframes" / "images") || !is_folder(root / "keyframes" / "cameras")) continue;
    p.root = root.string();
    return "a raw export of Polycam";
  }
  return "";
}

SceneInfo find_photographs(const PolycamParams&, PosedPhotographs& files, Diagnostics& diagnostics) {
  files.require({"", "keyframes", "keyframes/images", "keyframes/cameras"}, "a raw export of Polycam");
  const fs::path keyframes = fs::path(files.root()) / "keyframes";
  const std::string kind = is_corrected(keyframes) ? "corrected_" : "";
  std::vector<PosedPhotograph> photos;
  for (const std::string& image : files_with((keyframes / (kind + "images")).string(), kPhotographs)) {
    const std::string stem = fs::path(image).stem().string();
    PosedPhotograph photo;
    photo.color = image;
    photo.high = 255;
    if (!read_camera((keyframes / (kind + "cameras") / (stem + ".json")).string(), photo, diagnostics)) continue;
    photo.depth = in_folder(keyframes / "depth", stem + ".png");
    photo.confidence = (keyframes / "confidence" / (stem + ".png")).string();
    photos.push_back(std::move(photo));
  }
  return files.open(std::move(photos), {.opengl_files = true, .tracked = true}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(polycam, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<PolycamParams>, PolycamParams>(
      "polycam", "Raw exports of Polycam: photographs, poses and LiDAR depth of a phone.");
})

}  // namespace semfield
