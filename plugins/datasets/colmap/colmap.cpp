// COLMAP sparse models with their images; label images beside them where there are any.
#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <utility>
#include <vector>

#include "core/files.h"
#include "core/text.h"
#include "plugin/module.h"
#include "scene/loading/colmap_model.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

/// Its keys are those of PhotographParams but `every` and `least_confidence`.
struct ColmapParams : PhotographParams {
  std::string model, images = "images";
};

void describe(ParamVisitor& visit, ColmapParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the scene: it holds the sparse model and the images");
  SEMFIELD_PARAM(visit, p, model,
                 "folder inside root with cameras, images and points3D (.bin or .txt); empty = sparse/0, sparse, "
                 "colmap/sparse/0 or root itself");
  SEMFIELD_PARAM(visit, p, images, "folder inside root of the images that the model names; they may have any size");
  SEMFIELD_PARAM(visit, p, test_every, "every N-th frame, by name, is held out for tests; 0 = none", {0, 1e6});
  SEMFIELD_PARAM(visit, p, label_dir,
                 "folder inside root of label images: the name of the image with .png; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the one found in root");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
  SEMFIELD_PARAM(visit, p, masks, kMasksSentence);
}

namespace {

constexpr const char* kModelFolders[] = {"sparse/0", "sparse", "colmap/sparse/0", "."};

bool holds_model(const fs::path& folder) {
  return is_there(folder / "cameras.bin") || is_there(folder / "cameras.txt");
}

bool holds_files(const fs::path& folder, std::initializer_list<std::string_view> extensions) {
  try {
    return !files_with(folder.string(), {extensions.begin(), extensions.size()}).empty();
  } catch (const Error&) {  // a folder that cannot be read
    return false;
  }
}

}  // namespace

std::string recognise(const std::string& path, ColmapParams& p) {
  const fs::path root(path);
  const auto model = std::find_if(std::begin(kModelFolders), std::end(kModelFolders),
                                  [&](const char* folder) { return holds_model(root / folder); });
  if (model == std::end(kModelFolders)) return "";
  p.root = path;
  if (!is_folder(root / p.images)) {
    for (const char* folder : {".", "rgb", "color", "photos", "input"}) {
      if (!holds_files(root / folder, {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"})) continue;
      p.images = folder;
      break;
    }
  }
  for (const char* folder : {"labels", "label", "semantic", "semantic_class"})
    if (p.label_dir.empty() && holds_files(root / folder, {".png"})) p.label_dir = folder;
  return std::string("a COLMAP model") + (std::string(*model) == "." ? "" : std::string(" in ") + *model);
}

namespace {

// Bounds: the central 99 % of the points on every axis, a tenth wider each way, and the cameras. Distances: of the
// points inside them, as the images see them.
void set_extent(const ColmapModel& model, SceneInfo& info) {
  constexpr double kLost = 0.005, kMargin = 0.1;
  constexpr std::size_t kEnough = 100;
  if (model.points.size() < kEnough) return;
  Vec3d lo, hi;
  for (int a = 0; a < 3; ++a) {
    std::vector<double> values;
    for (const auto& [id, point] : model.points) values.push_back(point[a]);
    lo[a] = quantile(values, kLost);
    hi[a] = quantile(values, 1 - kLost);
  }
  Box box{lo - (hi - lo) * kMargin, hi + (hi - lo) * kMargin};
  for (const FrameInfo& frame : info.frames) box.include(frame.world_from_camera.t);
  std::vector<double> distances;
  for (const ColmapImage& image : model.images) {
    for (const std::int64_t id : image.points) {
      const auto found = model.points.find(id);
      if (found == model.points.end()) continue;
      const Vec3d p = found->second;
      const bool inside = p.x >= box.lo.x && p.x <= box.hi.x && p.y >= box.lo.y && p.y <= box.hi.y && p.z >= box.lo.z &&
                          p.z <= box.hi.z;
      const double distance = length(p - image.world_from_camera.t);
      if (inside && std::isfinite(distance) && distance > 0) distances.push_back(distance);
    }
  }
  info.bounds = box;
  if (distances.size() < kEnough) return;
  info.near_hint_m = 0.5 * quantile(distances, 0.001);
  info.far_hint_m = 1.2 * quantile(distances, 0.999);
}

std::string model_folder(const ColmapParams& params, const fs::path& root, Diagnostics& diagnostics) {
  require_folder(root, "check scene.root");
  if (!params.model.empty()) {
    if (holds_model(root / params.model)) return (root / params.model).string();
    throw Error(ErrorKind::no_input, "scene.poses.missing",
                "no cameras.bin or cameras.txt in '" + (root / params.model).string() + "'", "check scene.model");
  }
  for (const char* folder : kModelFolders) {
    if (!holds_model(root / folder)) continue;
    if (holds_model(root / folder / ".." / "1")) {
      diagnostics.note("scene.colmap.several", root.string(),
                       std::string("the reconstruction fell into several models; '") + folder +
                           "' is read, scene.model chooses another");
    }
    return (root / folder).lexically_normal().string();
  }
  throw Error(ErrorKind::no_input, "scene.poses.missing",
              "no cameras.bin or cameras.txt in '" + root.string() + "', its sparse/0 or sparse",
              "check scene.root, or name the model's folder with scene.model");
}

}  // namespace

SceneInfo find_photographs(const ColmapParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  const fs::path root(files.root());
  const std::string folder = model_folder(params, root, diagnostics);
  const ColmapModel model = read_colmap_model(folder, diagnostics);
  for (const auto& [what, name] : {std::pair{"images", params.images}, std::pair{"label_dir", params.label_dir}}) {
    if (!name.empty()) require_folder(root / name, std::string("check scene.") + what);
  }
  FileNames finder;
  std::vector<PosedPhotograph> photos;
  for (const ColmapImage& in : model.images) {
    PosedPhotograph photo;
    photo.color = finder.of((root / params.images / in.name).string());
    photo.name = in.name;
    photo.place = in.place;
    photo.camera = model.cameras.at(in.camera);
    photo.intrinsics = Intrinsics::fitted;
    photo.world_from_camera = in.world_from_camera;
    if (photo.camera.width_px > 0) photos.push_back(std::move(photo));  // one without a size was refused
  }
  SceneInfo info = files.open(std::move(photos), {.metric = false, .poses = folder}, diagnostics);
  set_extent(model, info);
  return info;
}

// Photographs without camera poses: the command that finds poses for them.

namespace {

constexpr std::size_t kFewest = 3;

// What files of camera poses are called, wherever they come from.
bool may_hold_poses(const fs::path& file) {
  const std::string name = lower_case(file.filename().string());
  const auto has = [&](const char* part) { return name.find(part) != std::string::npos; };
  const auto ends = [&](const char* ending) { return name.ends_with(ending); };
  return (has("traj") || has("pose") || has("groundtruth") || has("camera") || has("extrinsic") || has("transforms")) &&
         (ends(".txt") || ends(".json") || ends(".csv") || ends(".npy") || ends(".npz") || ends(".log"));
}

}  // namespace

std::string preparation(const std::string& folder, const ColmapParams&) {
  std::vector<std::string> photographs;
  fs::path where;
  std::vector<fs::path> places{folder};
  std::error_code unknown;
  if (is_folder(folder)) {
    for (const fs::directory_entry& entry : sorted_folder(folder)) {
      if (entry.is_directory(unknown)) places.push_back(entry.path());
    }
  }
  for (const fs::path& place : places) {
    std::vector<std::string> found = files_with(place.string(), kPhotographs);
    if (found.size() <= photographs.size()) continue;
    photographs = std::move(found);
    where = place;
  }
  if (photographs.size() < kFewest) return "";
  std::string poses;
  for (const fs::path& place : places) {
    if (!poses.empty() || !is_folder(place)) break;
    for (const fs::directory_entry& entry : sorted_folder(place.string()))
      if (poses.empty() && entry.is_regular_file(unknown) && may_hold_poses(entry.path()))
        poses = entry.path().string();
  }
  const std::string scene = folder + "_scene";
  if (!poses.empty())
    poses = "'" + poses +
            "' may hold poses, but not in a layout that a dataset reads: docs/guide/own_data.md lists them; write "
            "transforms.json with a frame for each image to use them.\n";
  return poses + "'" + where.string() + "' holds " + std::to_string(photographs.size()) +
         " photographs and no camera poses that a dataset knows. This finds poses, with COLMAP:\n" +
         "  semfield prepare " + shell_word(where.string()) + " --out " + shell_word(scene) + "\n" +
         "then: semfield init " + shell_word(scene);
}

SEMFIELD_PLUGIN_MODULE(colmap, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<ColmapParams>, ColmapParams>(
      "colmap", "COLMAP sparse models, binary or text, with their images.");
})

}  // namespace semfield
