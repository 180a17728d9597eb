// Record3D exports.
#include "datasets/record3d/record3d.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/text.h"
#include "formats/image_io.h"
#include "formats/input_limits.h"
#include "loading/camera_fit.h"
#include "plugin/module.h"
#include "scene/frame_split.h"
#include "scene/rotation.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace fs = std::filesystem;
using nlohmann::json;

void describe(ParamVisitor& visit, Record3dParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the export: it holds metadata.json, rgb/ and depth/");
  SEMFIELD_PARAM(visit, p, test_every, "every N-th frame, by number, is held out for tests; 0 = none", {0, 1e6});
  SEMFIELD_PARAM(visit, p, label_dir, "folder inside root of the label images <id>.png; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the one found in root");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
}

void validate(const Record3dParams& p, Diagnostics& diagnostics) {
  if (p.root.empty())
    diagnostics.error("scene.root.unnamed", "root", "the scene's folder is not given", "set scene.root");
  check_test_every(p.test_every, diagnostics);
}

namespace {

constexpr const char* kMetadata = "metadata.json";

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
    diagnostics.error(
        "scene.index.value", path,
        "row " + std::to_string(i) + " of '" + key + "' is not a list of " + std::to_string(N) + " numbers",
        "export the recording again");
    return false;
  }
  if (!out.empty()) return true;
  diagnostics.error("scene.index.format", path, std::string("has no list '") + key + "'", "export the recording again");
  return false;
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

}  // namespace

std::string recognise(const std::string& path, Record3dParams& p) {
  std::error_code ignored;
  for (const char* inner : {"", "EXR_RGBD"}) {
    const fs::path folder = *inner == '\0' ? fs::path(path) : fs::path(path) / inner;
    if (!fs::is_directory(folder / "rgb", ignored) || !fs::is_regular_file(folder / kMetadata, ignored)) continue;
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

Record3d::Record3d(const Record3dParams& params, const DatasetBuild& build)
    : params_(params), root_((fs::path(build.config_dir) / params.root).string()) {
  if (!params.classes.empty()) class_file_ = (fs::path(build.config_dir) / params.classes).string();
}

Record3d::Recording Record3d::read_recording(const std::string& path, Diagnostics& diagnostics) {
  json root;
  try {
    root = json::parse(read_pose_file(path));
  } catch (const json::exception& e) {
    throw Error(ErrorKind::data, "scene.index.format", "'" + path + "' is not valid JSON: " + json_cause(e.what()),
                "export the recording again");
  }
  if (!root.is_object())
    throw Error(ErrorKind::data, "scene.index.format", "'" + path + "' is not a map of 'K', 'w', 'h' and 'poses'",
                "export the recording again");
  Recording out;
  if (!rows_of(root, "poses", path, out.poses, diagnostics)) return {};
  double size[2] = {};
  for (const int i : {0, 1}) {
    const json& side = member(root, i == 0 ? "w" : "h");
    size[i] = side.is_number() ? side.get<double>() : 0;
  }
  if (!(size[0] >= 1 && size[0] <= 1 << 20 && size[1] >= 1 && size[1] <= 1 << 20)) {
    diagnostics.error("scene.image.size", path, "image size 'w' x 'h' is not a pair of whole numbers of pixels",
                      "export the recording again");
    return {};
  }
  out.camera.width_px = static_cast<std::int32_t>(std::lround(size[0]));
  out.camera.height_px = static_cast<std::int32_t>(std::lround(size[1]));
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
                        std::string("has ") + std::to_string(out.poses.size()) + " poses and " +
                            std::to_string(out.lens.size()) + " rows of '" + kEach + "'",
                        "export the recording again");
      return {};
    }
  }
  return out;
}

// Colour is that of the photograph; labels have its size, depth its shape.
void Record3d::add_frame(FrameInfo frame, const FrameFiles& files, FrameFileCheck& check, Diagnostics& diagnostics) {
  frame.has_depth = !files.depth.empty();
  frame.has_labels = !files.label.empty();
  check.check_headers(frame, {files.color, "", files.label, ""}, diagnostics);
  check_shape(files.depth, frame, "", diagnostics);
  info_.frames.push_back(frame);
  files_.push_back(files);
}

SceneInfo Record3d::open(Diagnostics& diagnostics) {
  info_ = {};
  info_.opengl_files = true;
  files_.clear();
  const fs::path root(root_);
  for (const char* name : {"", "rgb"}) {
    const fs::path folder = *name == '\0' ? root : root / name;
    if (!fs::is_directory(folder))
      throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + folder.string() + "' is missing",
                  "check scene.root; it names the folder of one export");
  }
  const std::string path = (root / kMetadata).string();
  const Recording recording = read_recording(path, diagnostics);
  info_.name = fs::weakly_canonical(root).filename().string();
  if (recording.poses.empty()) return info_;

  const std::map<std::int64_t, std::string> images = numbered_photographs((root / "rgb").string(), diagnostics);
  const bool has_depth = fs::is_directory(root / "depth");
  FrameFileCheck check(params_.missing, "label_dir");
  CameraFit sizes;
  std::vector<std::string> skipped;
  std::size_t rank = 0;
  check.expect(images.size());
  for (const auto& [number, image] : images) {
    const std::string stem = fs::path(image).stem().string();
    FrameInfo frame;
    frame.name = stem;
    frame.source = image;
    frame.split = HoldOut{params_.test_every}.split_of(rank++, images.size());
    const std::string place = frame_place(frame);
    // Frames that were deleted from the folder keep their poses in the file: only the number tells whose a pose is.
    const auto i = static_cast<std::size_t>(number);
    if (i >= recording.poses.size()) {
      diagnostics.error("scene.pose.count", place,
                        "'" + path + "' has " + std::to_string(recording.poses.size()) + " poses, of the frames 0 to " +
                            std::to_string(recording.poses.size() - 1),
                        "keep the names that the export gave, or remove the image");
      continue;
    }
    const std::array<double, 7>& pose = recording.poses[i];
    set_rotation(frame.world_from_camera, {pose[3], pose[0], pose[1], pose[2]});
    frame.world_from_camera.t = {pose[4], pose[5], pose[6]};
    frame.world_from_camera = opencv_from_opengl(frame.world_from_camera);
    const PoseState state = check_pose(frame.world_from_camera, place, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    FrameFiles files{image, has_depth ? (root / "depth" / (stem + ".exr")).string() : "", "", ""};
    if (state != PoseState::good || !check.present(frame, files, diagnostics)) continue;
    frame.camera = recording.camera;
    if (!recording.lens.empty()) {
      const auto& [fx, fy, cx, cy] = recording.lens[i];
      frame.camera = {frame.camera.width_px, frame.camera.height_px, fx, fy, cx, cy};
    }
    if (!sizes.fit(image, place, frame.camera, diagnostics) || !check_camera(frame.camera, place, diagnostics))
      continue;
    if (!params_.label_dir.empty()) {
      const fs::path label = root / params_.label_dir / (stem + ".png");
      if (fs::exists(label)) files.label = label.string();
    }
    add_frame(std::move(frame), files, check, diagnostics);
  }
  sizes.report(root_, diagnostics);
  check.report(root_, info_.frames.size(), diagnostics);
  if (!diagnostics.has_errors() || !skipped.empty()) report_skipped(skipped, info_.frames.size(), path, diagnostics);
  const bool has_labels =
      std::any_of(info_.frames.begin(), info_.frames.end(), [](const FrameInfo& f) { return f.has_labels; });
  if (!params_.label_dir.empty() && !has_labels && !info_.frames.empty())
    report_no_labels((root / params_.label_dir).string(), diagnostics);
  info_.classes = load_class_file(class_file_, {root_}, has_labels, diagnostics);
  return info_;
}

void Record3d::read(int frame, FrameBuffer& out) const {
  const auto i = static_cast<std::size_t>(frame);
  const FrameInfo& info = info_.frames.at(i);
  const FrameFiles& files = files_.at(i);
  read_frame_files(info, {files.color, "", files.label, ""}, {.unknown_labels = params_.unknown_labels}, info_.classes,
                   out);
  if (files.depth.empty()) return;
  try {
    out.depth_m = at_nearest_pixels(read_depth(files.depth), out.width_px, out.height_px);
  } catch (Error& e) {
    e.while_doing("frame '" + info.name + "'");
    throw;
  }
}

namespace {
void register_into(Registry& registry) {
  registry.add_dataset<Record3d, Record3dParams>("record3d",
                                                 "Exports of Record3D: photographs, poses and LiDAR depth of a phone.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(record3d, "1.0", register_into)

}  // namespace semfield
