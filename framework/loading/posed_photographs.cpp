#include "loading/posed_photographs.h"

#include <cmath>
#include <filesystem>

#include "config/params_read.h"
#include "formats/image_io.h"
#include "loading/camera_fit.h"
#include "loading/depth_images.h"
#include "loading/file_names.h"
#include "loading/frame_masks.h"
#include "scene/frame_split.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace fs = std::filesystem;

void describe(ParamVisitor& visit, PhotographParams& p) {
  SEMFIELD_PARAM(visit, p, root, "folder of the scene");
  SEMFIELD_PARAM(visit, p, every, "every N-th photograph is read: those of a recording are many, and alike", {1, 1e6});
  SEMFIELD_PARAM(visit, p, test_every,
                 "every N-th frame, in the order of the recording, is held out for tests; 0 = none", {0, 1e6});
  SEMFIELD_PARAM(visit, p, least_confidence,
                 "depth of less confidence counts as none; medium leaves out what the phone guesses");
  SEMFIELD_PARAM(visit, p, label_dir,
                 "folder inside root of the label images, named as the photographs; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the one found in root");
  SEMFIELD_PARAM(visit, p, masks, kMasksSentence);
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
}

void validate(const PhotographParams& p, Diagnostics& diagnostics) {
  if (p.root.empty())
    diagnostics.error("scene.root.unnamed", "root", "the scene's folder is not given", "set scene.root");
  check_test_every(p.test_every, diagnostics);
}

bool set_image_size(Camera& camera, double width, double height, const std::string& place, Diagnostics& diagnostics) {
  const auto whole = [](double v) { return v >= 1 && v <= 1 << 20 && v == std::floor(v); };
  if (!whole(width) || !whole(height)) {
    diagnostics.error("scene.image.size", place, "states no image size of whole pixels", "export the recording again");
    return false;
  }
  camera.width_px = static_cast<std::int32_t>(width);
  camera.height_px = static_cast<std::int32_t>(height);
  return true;
}

PosedPhotographs::PosedPhotographs(const PhotographParams& params, const std::string& config_dir)
    : params_(params), root_((fs::path(config_dir) / params.root).string()) {
  if (!params.classes.empty()) class_file_ = (fs::path(config_dir) / params.classes).string();
}

void PosedPhotographs::require(std::initializer_list<const char*> parts, const std::string& app) const {
  for (const char* part : parts) {
    const fs::path path = *part == '\0' ? fs::path(root_) : fs::path(root_) / part;
    std::error_code unknown;
    if (fs::exists(path, unknown)) continue;
    throw Error(ErrorKind::no_input, "files.folder.missing",
                "'" + path.string() + "' is missing, which " + app + " writes",
                "check scene.root; it names the folder of one export");
  }
}

SceneInfo PosedPhotographs::open(const std::vector<PosedPhotograph>& all, bool opengl_files, Diagnostics& diagnostics) {
  info_ = {};
  info_.opengl_files = opengl_files;
  info_.name = fs::weakly_canonical(root_).filename().string();
  files_.clear();
  photos_.clear();
  FrameNames names;
  FileNames finder;
  FrameFileCheck check(params_.missing, "label_dir");
  CameraFit sizes;
  FrameMasks masks(root_, params_.masks);
  std::vector<std::string> skipped;
  bool has_labels = false;
  std::vector<PosedPhotograph> photos;
  for (std::size_t i = 0; i < all.size(); i += static_cast<std::size_t>(params_.every)) photos.push_back(all[i]);
  check.expect(photos.size());
  for (std::size_t i = 0; i < photos.size(); ++i) {
    const PosedPhotograph& photo = photos[i];
    FrameInfo frame;
    frame.name = names.of(photo.image);
    frame.source = photo.image;
    frame.split = HoldOut{params_.test_every}.split_of(i, photos.size());
    frame.world_from_camera = photo.world_from_camera;
    frame.camera = photo.camera;
    const std::string place = frame_place(frame);
    const PoseState state = check_pose(frame.world_from_camera, place, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    FrameFiles files;
    files.color = photo.image;
    files.depth = finder.of(photo.depth);
    masks.add_to(files);
    if (!params_.label_dir.empty()) {
      const fs::path label =
          finder.of((fs::path(root_) / params_.label_dir / (fs::path(photo.image).stem().string() + ".png")).string());
      std::error_code unknown;
      if (fs::exists(label, unknown)) files.label = label.string();
    }
    if (state != PoseState::good || !check.present(frame, files, diagnostics) ||
        !sizes.fit(photo.image, place, frame.camera, diagnostics) ||
        !check_principal_point(frame.camera, place, diagnostics) || !check_camera(frame.camera, place, diagnostics))
      continue;
    frame.has_depth = !files.depth.empty();
    frame.has_labels = !files.label.empty();
    has_labels = has_labels || frame.has_labels;
    check_shape(files.depth, frame, "", diagnostics);
    FrameFiles whole = files;  // depth has a size of its own
    whole.depth.clear();
    check.check_headers(frame, whole, diagnostics);
    info_.frames.push_back(std::move(frame));
    files_.push_back(std::move(files));
    photos_.push_back(photo);
    photos_.back().confidence = finder.of(photo.confidence);
  }
  sizes.report(root_, diagnostics);
  masks.report(diagnostics);
  check.report(root_, info_.frames.size(), diagnostics);
  if (!diagnostics.has_errors() || !skipped.empty()) report_skipped(skipped, info_.frames.size(), root_, diagnostics);
  if (!params_.label_dir.empty() && !has_labels && !info_.frames.empty())
    report_no_labels((fs::path(root_) / params_.label_dir).string(), diagnostics);
  info_.classes = load_class_file(class_file_, {root_}, has_labels, diagnostics);
  return info_;
}

void PosedPhotographs::read(int frame, FrameBuffer& out) const {
  const auto i = static_cast<std::size_t>(frame);
  FrameFiles whole = files_.at(i);
  whole.depth.clear();
  read_frame_files(info_.frames[i], whole, {.unknown_labels = params_.unknown_labels}, info_.classes, out);
  if (files_[i].depth.empty()) return;
  try {
    Image<float> depth = read_depth(files_[i].depth, photos_[i].depth_unit_m);
    std::error_code unknown;
    const std::string& rating = photos_[i].confidence;
    if (params_.least_confidence != Confidence::low && !rating.empty() && fs::exists(rating, unknown)) {
      const Image<std::uint16_t> confidence = read_ids(rating);
      if (confidence.pixels.size() != depth.pixels.size())
        throw Error(ErrorKind::data, "scene.image.size",
                    "'" + rating + "' is " + size_text(confidence.width_px, confidence.height_px) +
                        " pixels, its depth " + size_text(depth.width_px, depth.height_px),
                    "export the recording again, or set scene.least_confidence=low");
      const int least = params_.least_confidence == Confidence::high ? photos_[i].high : 1;
      for (std::size_t p = 0; p < depth.pixels.size(); ++p)
        if (confidence.pixels[p] < least) depth.pixels[p] = 0;
    }
    out.depth_m = at_nearest_pixels(depth, out.width_px, out.height_px);
  } catch (Error& e) {
    e.while_doing("frame '" + info_.frames[i].name + "'");
    throw;
  }
}

}  // namespace semfield
