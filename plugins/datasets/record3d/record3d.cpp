// Exports of Record3D from a phone with LiDAR: rgb/, depth/ and metadata.json.
#include <fmt/format.h>

#include <array>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

using nlohmann::json;

struct Record3dParams : PhotographParams {};

namespace {

constexpr const char *kMetadata = "metadata.json", *kAgain = "export the recording again";

const json& member(const json& map, const char* key) {
  static const json none;
  const auto found = map.find(key);
  return found == map.end() ? none : *found;
}

// The numbers of a list that has to hold N of them; not finite ones stand as null in JSON.
template <std::size_t N>
bool numbers_of(const json& list, std::array<double, N>& out) {
  if (!list.is_array() || list.size() != N) return false;
  for (std::size_t i = 0; i < N; ++i) {
    if (!list[i].is_number() && !list[i].is_null()) return false;
    out[i] = list[i].is_null() ? std::numeric_limits<double>::quiet_NaN() : list[i].get<double>();
  }
  return true;
}

// The lists of a key, each of N numbers; false when reported.
template <std::size_t N>
bool rows_of(const json& root, const char* key, const std::string& path, std::vector<std::array<double, N>>& out,
             Diagnostics& diagnostics) {
  const json& rows = member(root, key);
  out.resize(rows.is_array() ? rows.size() : 0);
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (numbers_of(rows[i], out[i])) continue;
    diagnostics.error("scene.index.value", path, fmt::format("row {} of '{}' is not a list of {} numbers", i, key, N),
                      kAgain);
    return false;
  }
  if (out.empty()) diagnostics.error("scene.index.format", path, fmt::format("has no list '{}'", key), kAgain);
  return !out.empty();
}

// Column by column as the app writes it; row by row as others store a matrix.
bool set_lens(const std::array<double, 9>& k, Camera& camera) {
  const bool by_column = k[2] == 0 && k[5] == 0, by_row = k[6] == 0 && k[7] == 0;
  if (by_column == by_row || k[1] != 0 || k[3] != 0 || k[8] != 1) return false;
  camera.fx = k[0];
  camera.fy = k[4];
  camera.cx = by_column ? k[6] : k[2];
  camera.cy = by_column ? k[7] : k[5];
  return true;
}

/// What metadata.json tells.
struct Recording {
  Camera camera;                             ///< of all frames, at the size that the file states
  std::vector<std::array<double, 4>> lens;   ///< fx, fy, cx, cy of each frame; empty where the file has none
  std::vector<std::array<double, 7>> poses;  ///< of each frame: quaternion x, y, z, w, and centre
};

Recording read_recording(const std::string& path, Diagnostics& diagnostics) {
  const json root = read_pose_json<json>(path, kAgain);
  if (!root.is_object())
    throw Error(ErrorKind::data, "scene.index.format", "'" + path + "' is not a map of 'K', 'w', 'h' and 'poses'",
                kAgain);
  Recording out;
  if (!rows_of(root, "poses", path, out.poses, diagnostics)) return {};
  const auto side = [&](const char* key) { return member(root, key).is_number() ? root[key].get<double>() : 0; };
  if (!set_image_size(out.camera, side("w"), side("h"), path, diagnostics)) return {};
  std::array<double, 9> k{};
  if (!numbers_of(member(root, "K"), k) || !set_lens(k, out.camera)) {
    diagnostics.error("scene.camera.format", path, "'K' is not a pinhole camera without skew",
                      "write [fx, 0, 0, 0, fy, 0, cx, cy, 1], the matrix column by column");
    return {};
  }
  if (!check_principal_point(out.camera, path, diagnostics)) return {};
  constexpr const char* kEach = "perFrameIntrinsicCoeffs";
  if (!member(root, kEach).empty()) {
    if (!rows_of(root, kEach, path, out.lens, diagnostics)) return {};
    if (out.lens.size() != out.poses.size()) {
      diagnostics.error("scene.pose.count", path,
                        fmt::format("has {} poses and {} rows of '{}'", out.poses.size(), out.lens.size(), kEach),
                        kAgain);
      return {};
    }
  }
  return out;
}

}  // namespace

std::string recognise(const std::string& path, Record3dParams& p) {
  for (const char* inner : {"", "EXR_RGBD"}) {
    const fs::path folder = *inner == '\0' ? fs::path(path) : fs::path(path) / inner;
    if (!is_folder(folder / "rgb") || !is_file(folder / kMetadata)) continue;
    try {  // other recordings have a file of that name too
      if (read_pose_file((folder / kMetadata).string()).find("\"poses\"") == std::string::npos) continue;
    } catch (const Error&) {
      continue;
    }
    p.root = folder.string();
    return "an export of Record3D";
  }
  return "";
}

SceneInfo find_photographs(const Record3dParams&, PosedPhotographs& files, Diagnostics& diagnostics) {
  files.require({"", "rgb", kMetadata}, "an export of Record3D");
  const fs::path root(files.root());
  const std::string path = (root / kMetadata).string();
  const Recording recording = read_recording(path, diagnostics);
  std::vector<PosedPhotograph> photos;
  if (recording.poses.empty()) return {};
  for (const auto& [number, image] : numbered_photographs((root / "rgb").string(), diagnostics)) {
    // Frames that were deleted from the folder keep their poses in the file: only the number tells whose a pose is.
    const auto i = static_cast<std::size_t>(number);
    if (i >= recording.poses.size()) {
      const std::size_t count = recording.poses.size();
      diagnostics.error("scene.pose.count", "'" + image + "'",
                        fmt::format("'{}' has {} poses, of the frames 0 to {}", path, count, count - 1),
                        "keep the names that the export gave, or remove the image");
      continue;
    }
    PosedPhotograph photo;
    photo.color = image;
    photo.depth = in_folder(root / "depth", fs::path(image).stem().string() + ".exr");
    const auto& [qx, qy, qz, qw, x, y, z] = recording.poses[i];
    set_rotation(photo.world_from_camera, {qw, qx, qy, qz});
    photo.world_from_camera.t = {x, y, z};
    photo.world_from_camera = opencv_from_opengl(photo.world_from_camera);
    photo.camera = recording.camera;
    if (!recording.lens.empty()) {
      const auto& [fx, fy, cx, cy] = recording.lens[i];
      photo.camera = {photo.camera.width_px, photo.camera.height_px, fx, fy, cx, cy};
    }
    photos.push_back(std::move(photo));
  }
  return files.open(std::move(photos), {.opengl_files = true, .tracked = true}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(record3d, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<Record3dParams>, Record3dParams>(
      "record3d", "Exports of Record3D: photographs, poses and LiDAR depth of a phone.");
})

}  // namespace semfield
