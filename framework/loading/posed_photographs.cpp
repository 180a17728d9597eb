#include "loading/posed_photographs.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "config/params.h"
#include "core/error.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "scene/scene.h"
#include "system/files.h"

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
  check_root_and_test_every(p.root, p.test_every, diagnostics);
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
    : params_(params),
      root_((fs::path(config_dir) / params.root).string()),
      class_file_(DatasetBuild{config_dir}.path_of(params.classes)) {}

void PosedPhotographs::require(std::initializer_list<const char*> parts, const std::string& app) const {
  for (const char* part : parts) {
    const fs::path path = *part == '\0' ? fs::path(root_) : fs::path(root_) / part;
    if (is_there(path)) continue;
    throw Error(ErrorKind::no_input, "files.folder.missing",
                "'" + path.string() + "' is missing, which " + app + " writes",
                "check scene.root; it names the folder of one export");
  }
}

SceneInfo PosedPhotographs::open(const std::vector<PosedPhotograph>& all, bool opengl_files, Diagnostics& diagnostics,
                                 const std::string& poses) {
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
  std::size_t labelled = 0;
  std::vector<PosedPhotograph> photos;
  for (std::size_t i = 0; i < all.size(); i += static_cast<std::size_t>(params_.every)) photos.push_back(all[i]);
  check.expect(photos.size());
  for (std::size_t i = 0; i < photos.size(); ++i) {
    const PosedPhotograph& photo = photos[i];
    FrameInfo frame;
    const std::string& name = photo.name.empty() ? photo.image : photo.name;
    frame.name = names.of(name);
    frame.source = photo.image;
    frame.split = HoldOut{params_.test_every}.split_of(i, photos.size());
    frame.world_from_camera = photo.world_from_camera;
    frame.camera = photo.camera;
    const std::string place = frame_place(frame);
    const PoseState state = check_pose(frame.world_from_camera, photo.place.empty() ? place : photo.place, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    FrameFiles files;
    files.color = photo.image;
    files.depth = finder.of(photo.depth);
    masks.add_to(files);
    if (!params_.label_dir.empty()) {
      const fs::path as_image = photo.name.empty() ? fs::path(name).filename() : fs::path(name);
      const std::string label =
          finder.of((fs::path(root_) / params_.label_dir / as_image).replace_extension(".png").string());
      if (is_there(label)) files.label = label;
    }
    if (state != PoseState::good || !check.present(frame, files, diagnostics) ||
        !sizes.fit(photo.image, place, frame.camera, diagnostics) ||
        (!photo.fitted && !check_principal_point(frame.camera, place, diagnostics)) ||
        !check_camera(frame.camera, place, diagnostics))
      continue;
    files.tell_channels(frame);
    labelled += frame.has_labels ? 1 : 0;
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
  report_skipped(skipped, info_.frames.size(), poses.empty() ? root_ : poses, diagnostics);
  if (!params_.label_dir.empty())
    report_unlabelled((fs::path(root_) / params_.label_dir).string(), labelled, info_.frames.size(), diagnostics);
  info_.classes = load_class_file(class_file_, {root_}, labelled > 0, diagnostics);
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
    const std::string& rating = photos_[i].confidence;
    if (params_.least_confidence != Confidence::low && !rating.empty() && is_there(rating)) {
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
    out.depth_m = at_nearest_pixels(depth.pixels, {depth.width_px, depth.height_px}, {out.width_px, out.height_px});
  } catch (Error& e) {
    e.while_doing("frame '" + info_.frames[i].name + "'");
    throw;
  }
}

namespace {

std::string number(double value) { return fmt::format("{:.4g}", value); }

// Of one shape, but for a side that was rounded to whole pixels.
bool is_scaled(const ImageSize& size, const Camera& camera) {
  const double sx = static_cast<double>(size.width_px) / camera.width_px;
  const double sy = static_cast<double>(size.height_px) / camera.height_px;
  return std::abs(sx * camera.height_px - size.height_px) < 1 || std::abs(sy * camera.width_px - size.width_px) < 1;
}

// "2 times as large as": the camera's image against the file.
std::string factor_text(const ImageSize& size, const Camera& camera) {
  const double factor = static_cast<double>(camera.width_px) / size.width_px;
  return factor > 1 ? number(factor) + " times as large" : number(1 / factor) + " times as small";
}

}  // namespace

OtherSize other_size(std::string_view what, const std::string& path, const ImageSize& size, const Camera& camera) {
  OtherSize out{"scene.image.size",
                std::string(what) + " '" + path + "' is " + size_text(size.width_px, size.height_px) +
                    " pixels, the camera " + size_text(camera.width_px, camera.height_px),
                "colour, depth and labels of a frame need the size that its camera states"};
  if (what != kColorImage) return out;
  if (size.width_px != size.height_px && size.width_px == camera.height_px && size.height_px == camera.width_px) {
    out.code = "scene.image.turned";
    if (turned_by_quarter(size.orientation)) {
      out.message += ", which is that of the picture turned as the file's EXIF orientation says (" +
                     std::to_string(size.orientation) + ")";
      out.remedy = "pixels are read as they are stored: turn them, for example with `mogrify -auto-orient FILES`";
    } else {
      out.message += ": one is turned by a quarter against the other";
      out.remedy = "turn the image files by a quarter, or export the cameras of the images as they are stored";
    }
  } else if (is_scaled(size, camera)) {
    out.code = "scene.camera.size";
    out.message += ": its intrinsics are of images " + factor_text(size, camera);
    out.remedy = "give images of the camera's size, or divide its size, focal lengths and centre by " +
                 number(static_cast<double>(camera.width_px) / size.width_px);
  }
  return out;
}

bool CameraFit::fit(const std::string& image, const std::string& place, Camera& camera, Diagnostics& diagnostics) {
  ImageSize size;
  try {
    size = image_size(image);
  } catch (const Error&) {
    return true;
  }
  if (size.width_px == camera.width_px && size.height_px == camera.height_px) return true;
  if (!is_scaled(size, camera)) {
    OtherSize wrong = other_size(kColorImage, image, size, camera);
    const bool turned = size.width_px == camera.height_px && size.height_px == camera.width_px;
    diagnostics.error(turned ? wrong.code : Code("scene.image.aspect"), place,
                      turned ? wrong.message : wrong.message + ": another aspect ratio",
                      turned ? wrong.remedy : "give the images that the cameras were made from, or scaled copies");
    return false;
  }
  Scaled& one = scaled_[factor_text(size, camera)];
  if (one.frames++ == 0) {
    one.text = size_text(size.width_px, size.height_px) + " pixels, the cameras' " +
               size_text(camera.width_px, camera.height_px) + ", " + factor_text(size, camera);
  }
  camera = camera.resized(size.width_px, size.height_px);
  return true;
}

void CameraFit::report(const std::string& source, Diagnostics& diagnostics) const {
  for (const auto& [factor, one] : scaled_) {
    diagnostics.note(
        "scene.camera.scaled", source,
        "images are " + one.text + ": the intrinsics of " + std::to_string(one.frames) + " frames were scaled");
  }
}

}  // namespace semfield
