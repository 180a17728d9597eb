// LLFF scenes: poses_bounds.npy and a folder of images in the order of their names.
#include <algorithm>
#include <cmath>

#include "core/files.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "plugin/module.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

/// Its keys are those of PhotographParams but `every`, `least_confidence` and `missing`.
struct LlffParams : PhotographParams {
  std::string images = "images";
};

namespace {

constexpr const char* kPosesFile = "poses_bounds.npy";
// A number of pixels, but for the rounding of a sum.
bool is_size(double pixels) { return pixels >= 1 && pixels <= 1 << 20 && std::abs(pixels - std::round(pixels)) < 1e-3; }

constexpr std::size_t kRow = 17;  // a frame: 3 x 5 numbers row by row, near, far, of which the last two are not read

}  // namespace

void describe(ParamVisitor& visit, LlffParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the scene: it holds poses_bounds.npy and the images");
  SEMFIELD_PARAM(
      visit, p, images,
      "folder inside root of the images, which the rows of poses_bounds.npy take in the order of their names; "
      "they may have any size");
  SEMFIELD_PARAM(visit, p, test_every, "every N-th frame, by name, is held out for tests; 0 = none", {0, 1e6});
  SEMFIELD_PARAM(visit, p, label_dir,
                 "folder inside root of label images: the name of the image with .png; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the one found in root");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, masks, kMasksSentence);
}

std::string recognise(const std::string& path, LlffParams& p) {
  if (!is_file(fs::path(path) / kPosesFile)) return "";
  p.root = path;
  return std::string("LLFF's ") + kPosesFile;
}

SceneInfo find_photographs(const LlffParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  const fs::path root(files.root()), folder = root / params.images;
  const std::string path = (root / kPosesFile).string();
  require_folder(root, "check scene.root");
  const NumpyArray poses = read_npy(path, [&](std::span<const std::int64_t> shape) {
    if (shape.size() == 2 && shape[0] > 0 && shape[1] == static_cast<std::int64_t>(kRow)) return;
    throw Error(ErrorKind::data, "scene.pose.format",
                "shape " + shape_text(shape) + " is not that of poses: 17 numbers per frame",
                "write 3 x 5 numbers of pose and size, near and far for each frame");
  });
  require_folder(folder, "check scene.images");
  const std::vector<std::string> images = files_with(folder.string(), kPhotographs);
  const std::size_t count = poses.values.size() / kRow;
  if (images.size() != count) {
    throw Error(ErrorKind::data, "scene.pose.count",
                "'" + path + "' has " + std::to_string(count) + " frames, '" + folder.string() + "' " +
                    std::to_string(images.size()) + " images",
                "keep those images that the poses are of: rows go by the order of names");
  }
  std::vector<PosedPhotograph> photos;
  for (std::size_t i = 0; i < count; ++i) {
    // Columns are the camera's axes down, right and backward, its centre, and (height, width, focal length).
    const float* row = poses.values.data() + i * kRow;
    const auto at = [row](std::size_t r, std::size_t c) { return static_cast<double>(row[5 * r + c]); };
    PosedPhotograph photo;
    photo.color = images[i];
    for (std::size_t r = 0; r < 3; ++r) photo.world_from_camera.r[r] = {at(r, 1), at(r, 0), -at(r, 2)};
    photo.world_from_camera.t = {at(0, 3), at(1, 3), at(2, 3)};
    const double height = at(0, 4), width = at(1, 4), focal = at(2, 4);
    double sum = 0;
    for (std::size_t r = 0; r < 3; ++r)
      for (std::size_t c = 0; c < 4; ++c) sum += at(r, c);
    if (!std::isfinite(sum)) {  // a frame without a pose is left out and named, whatever else its row says
      photos.push_back(std::move(photo));
      continue;
    }
    if (!is_size(width) || !is_size(height)) {
      diagnostics.error("scene.camera.format",
                        "frame '" + fs::path(images[i]).stem().string() + "' (" + images[i] + ")",
                        "'" + path + "' states no image size in its row " + std::to_string(i),
                        "write height and width in whole pixels, and the focal length, in the fifth column");
      continue;
    }
    const auto w = static_cast<std::int32_t>(std::lround(width)), h = static_cast<std::int32_t>(std::lround(height));
    photo.camera = {w, h, focal, focal, 0.5 * w, 0.5 * h};
    photos.push_back(std::move(photo));
  }
  // Nothing in the file tells the unit.
  return files.open(std::move(photos), {.metric = false, .poses = path}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(llff, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<LlffParams>, LlffParams>("llff", "Images with the poses_bounds.npy of LLFF.");
})

}  // namespace semfield
