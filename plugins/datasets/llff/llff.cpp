// LLFF scenes.
#include "datasets/llff/llff.h"

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "formats/image_io.h"
#include "formats/npz.h"
#include "loading/frame_files.h"
#include "loading/frame_masks.h"
#include "loading/posed_photographs.h"
#include "plugin/module.h"
#include "scene/scene.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace fs = std::filesystem;

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

void validate(const LlffParams& p, Diagnostics& diagnostics) {
  if (p.root.empty())
    diagnostics.error("scene.root.unnamed", "root", "the scene's folder is not given", "set scene.root");
  check_test_every(p.test_every, diagnostics);
}

std::string recognise(const std::string& path, LlffParams& p) {
  std::error_code ignored;
  if (!fs::is_regular_file(fs::path(path) / kPosesFile, ignored)) return "";
  p.root = path;
  return std::string("LLFF's ") + kPosesFile;
}

Llff::Llff(const LlffParams& params, const DatasetBuild& build)
    : params_(params), root_((fs::path(build.config_dir) / params.root).string()) {
  if (!params.classes.empty()) class_file_ = (fs::path(build.config_dir) / params.classes).string();
}

std::vector<std::string> Llff::image_files() const {
  const fs::path folder = fs::path(root_) / params_.images;
  if (!fs::is_directory(folder))
    throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + folder.string() + "' is missing",
                "check scene.images");
  return files_with(folder.string(), kPhotographs);
}

SceneInfo Llff::open(Diagnostics& diagnostics) {
  info_ = {};
  info_.metric = false;  // nothing in the file tells the unit
  files_.clear();
  const std::string path = (fs::path(root_) / kPosesFile).string();
  if (!fs::is_directory(root_))
    throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + root_ + "' is missing", "check scene.root");
  const NumpyArray poses = read_npy(path, [&](std::span<const std::int64_t> shape) {
    if (shape.size() == 2 && shape[0] > 0 && shape[1] == static_cast<std::int64_t>(kRow)) return;
    throw Error(ErrorKind::data, "scene.pose.format",
                "shape " + shape_text(shape) + " is not that of poses: 17 numbers per frame",
                "write 3 x 5 numbers of pose and size, near and far for each frame");
  });
  const std::vector<std::string> images = image_files();
  const std::size_t count = poses.values.size() / kRow;
  if (images.size() != count) {
    throw Error(ErrorKind::data, "scene.pose.count",
                "'" + path + "' has " + std::to_string(count) + " frames, '" +
                    (fs::path(root_) / params_.images).string() + "' " + std::to_string(images.size()) + " images",
                "keep those images that the poses are of: rows go by the order of names");
  }
  info_.name = fs::weakly_canonical(root_).filename().string();

  std::vector<std::string> skipped;
  FrameNames names;
  FileNames finder;
  FrameFileCheck check(MissingFiles::error, "label_dir");
  CameraFit sizes;
  FrameMasks masks(root_, params_.masks);
  check.expect(count);
  bool has_labels = false;
  for (std::size_t i = 0; i < count; ++i) {
    const float* row = poses.values.data() + i * kRow;
    FrameInfo frame;
    FrameFiles files;
    frame.name = names.of(images[i]);
    frame.source = files.color = images[i];
    masks.add_to(files);
    frame.split = HoldOut{params_.test_every}.split_of(i, count);
    // Columns are the camera's axes down, right and backward, its centre, and (height, width, focal length).
    const auto at = [row](std::size_t r, std::size_t c) { return static_cast<double>(row[5 * r + c]); };
    for (std::size_t r = 0; r < 3; ++r) frame.world_from_camera.r[r] = {at(r, 1), at(r, 0), -at(r, 2)};
    frame.world_from_camera.t = {at(0, 3), at(1, 3), at(2, 3)};
    const std::string place = frame_place(frame);
    const PoseState state = check_pose(frame.world_from_camera, place, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    if (state != PoseState::good || !check.present(frame, files, diagnostics)) continue;
    const double height = at(0, 4), width = at(1, 4), focal = at(2, 4);
    if (!is_size(width) || !is_size(height)) {
      diagnostics.error("scene.camera.format", place,
                        "'" + path + "' states no image size in its row " + std::to_string(i),
                        "write height and width in whole pixels, and the focal length, in the fifth column");
      continue;
    }
    frame.camera.width_px = static_cast<std::int32_t>(std::lround(width));
    frame.camera.height_px = static_cast<std::int32_t>(std::lround(height));
    frame.camera.fx = frame.camera.fy = focal;
    frame.camera.cx = 0.5 * frame.camera.width_px;
    frame.camera.cy = 0.5 * frame.camera.height_px;
    if (!sizes.fit(files.color, place, frame.camera, diagnostics) || !check_camera(frame.camera, place, diagnostics))
      continue;
    if (!params_.label_dir.empty()) {
      const fs::path label = finder.of(
          (fs::path(root_) / params_.label_dir / fs::path(images[i]).filename()).replace_extension(".png").string());
      std::error_code ignored;
      if (fs::exists(label, ignored)) files.label = label.string();
    }
    frame.has_labels = !files.label.empty();
    has_labels = has_labels || frame.has_labels;
    check.check_headers(frame, files, diagnostics);
    info_.frames.push_back(frame);
    files_.push_back(files);
  }
  sizes.report(root_, diagnostics);
  masks.report(diagnostics);
  check.report(root_, info_.frames.size(), diagnostics);
  if (!diagnostics.has_errors() || !skipped.empty()) report_skipped(skipped, info_.frames.size(), path, diagnostics);
  if (!params_.label_dir.empty() && !has_labels && !info_.frames.empty())
    report_no_labels((fs::path(root_) / params_.label_dir).string(), diagnostics);
  info_.classes = load_class_file(class_file_, {root_}, has_labels, diagnostics);
  return info_;
}

void Llff::read(int frame, FrameBuffer& out) const {
  const auto i = static_cast<std::size_t>(frame);
  read_frame_files(info_.frames.at(i), files_.at(i), {.unknown_labels = params_.unknown_labels}, info_.classes, out);
}

namespace {
void register_into(Registry& registry) {
  registry.add_dataset<Llff, LlffParams>("llff", "Images with the poses_bounds.npy of LLFF.");
}
}  // namespace

SEMFIELD_PLUGIN_MODULE(llff, "1.0", register_into)

}  // namespace semfield
