#include "scene/loading/posed_photographs.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>

#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/npz.h"
#include "scene/loading/frame_source.h"

namespace semfield {

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

void set_first_size(Camera& camera, const std::vector<PosedPhotograph>& photographs, std::string FrameFiles::*file) {
  for (const PosedPhotograph& photograph : photographs) {
    try {
      const ImageSize size = image_size(photograph.*file);
      camera.width_px = size.width_px;
      camera.height_px = size.height_px;
      return;
    } catch (const Error&) {
      continue;
    }
  }
}

// Whether the camera of a frame is that of its image: the size that it states against the size of the file.

namespace {

constexpr const char* kColorImage = "colour image";

std::string number(double value) { return fmt::format("{:.4g}", value); }

// Of an image or a camera.
template <class Sized>
std::string size_of(const Sized& image) {
  return size_text(image.width_px, image.height_px);
}

bool same_size(const ImageSize& size, const Camera& camera) {
  return size.width_px == camera.width_px && size.height_px == camera.height_px;
}
bool is_turned(const ImageSize& size, const Camera& camera) {
  return size.width_px == camera.height_px && size.height_px == camera.width_px;
}

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

// What is wrong between an image of a frame and a camera of another size, and what to do. Of a colour image it says by
// which factor the intrinsics are off, or that it is turned by a quarter, by its EXIF orientation where that says so.
struct OtherSize {
  Code code;
  std::string message, remedy;
};

OtherSize other_size(std::string_view what, const std::string& path, const ImageSize& size, const Camera& camera) {
  OtherSize out{"scene.image.size",
                fmt::format("{} '{}' is {} pixels, the camera {}", what, path, size_of(size), size_of(camera)),
                "colour, depth and labels of a frame need the size that its camera states"};
  if (what != kColorImage) return out;
  if (size.width_px != size.height_px && is_turned(size, camera)) {
    out.code = "scene.image.turned";
    if (turned_by_quarter(size.orientation)) {
      out.message += fmt::format(", which is that of the picture turned as the file's EXIF orientation says ({})",
                                 size.orientation);
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

// Cameras of images that are scaled copies of those that they were made from: intrinsics follow the ratio of sizes.
class CameraFit {
 public:
  // Brings `camera` to the size of the file, where both are of one shape but for a rounded side. False when it reported
  // that they are not. A file that cannot be read is left to FrameFileCheck.
  bool fit(const std::string& image, const std::string& place, Camera& camera, Diagnostics& diagnostics) {
    ImageSize size;
    try {
      size = image_size(image);
    } catch (const Error&) {
      return true;
    }
    if (same_size(size, camera)) return true;
    if (!is_scaled(size, camera)) {
      OtherSize wrong = other_size(kColorImage, image, size, camera);
      if (!is_turned(size, camera))
        wrong = {"scene.image.aspect", wrong.message + ": another aspect ratio",
                 "give the images that the cameras were made from, or scaled copies"};
      diagnostics.error(wrong.code, place, wrong.message, wrong.remedy);
      return false;
    }
    const std::string factor = factor_text(size, camera);
    Scaled& one = scaled_[factor];
    if (one.frames++ == 0)
      one.text = fmt::format("{} pixels, the cameras' {}, {}", size_of(size), size_of(camera), factor);
    camera = camera.resized(size.width_px, size.height_px);
    return true;
  }
  // After the last frame: a note under `source` of the cameras that were scaled.
  void report(const std::string& source, Diagnostics& diagnostics) const {
    for (const auto& [factor, one] : scaled_)
      diagnostics.note("scene.camera.scaled", source,
                       fmt::format("images are {}: the intrinsics of {} frames were scaled", one.text, one.frames));
  }

 private:
  struct Scaled {
    std::string text;
    std::size_t frames = 0;
  };
  std::map<std::string, Scaled> scaled_;  // factor -> what of the first frame
};

// Files of a frame, which can do without all but the first; `shown`: drawn over the picture as viewers show it.
struct Kind {
  const char* what;
  std::string FrameFiles::*path;
  bool shown = false;
};
constexpr std::array<Kind, 6> kKinds{{{kColorImage, &FrameFiles::color},
                                      {"depth image", &FrameFiles::depth},
                                      {"label image", &FrameFiles::label, true},
                                      {"instance image", &FrameFiles::instance, true},
                                      {"mask", &FrameFiles::mask},
                                      {"mask of moving things", &FrameFiles::moving}}};

bool is_optional(const std::string& what) {
  return std::any_of(kKinds.begin() + 1, kKinds.end(), [&](const Kind& one) { return what == one.what; });
}

// "a, b, c, ..."
std::string first_names(const std::vector<std::string>& names) {
  constexpr std::size_t kNamed = 8;
  if (names.size() <= kNamed) return join(names);
  return join({names.begin(), names.begin() + kNamed}) + ", ...";
}

// A picture beside `path` that is called like it up to the extension; "" when there is none.
std::string same_with_other_extension(const fs::path& path) {
  for (const char* extension : {".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".exr"}) {
    const std::string other = fs::path(path).replace_extension(extension).string();
    if (other != path && is_there(other)) return other;
  }
  return "";
}

// As in "scene/C:/photos/1.jpg".
bool has_drive(const std::string& path) {
  const std::size_t colon = path.find(":/");
  return colon != std::string::npos && colon > 0 && std::isalpha(static_cast<unsigned char>(path[colon - 1])) != 0 &&
         (colon == 1 || path[colon - 2] == '/');
}

// The pattern of scene.labels.from that gives this file for this frame.
std::string label_pattern(const FrameInfo& frame, const fs::path& label) {
  const std::string stem = label.stem().string(), extension = label.extension().string();
  if (stem == frame.name) return "{name}" + extension;
  if (stem == fs::path(frame.source).stem().string()) return "{stem}" + extension;
  const std::size_t digits = stem.find_last_not_of("0123456789") + 1;
  const std::size_t own = frame.name.find_last_not_of("0123456789") + 1;
  if (digits < stem.size() && own < frame.name.size()) return stem.substr(0, digits) + "{number}" + extension;
  return "{name}" + extension;
}

// Settings that read this file as one of label files in place of the scene's own; `more` are further keys.
std::string label_settings(const FrameInfo& frame, const fs::path& label, const std::string& labels_key,
                           const std::string& more) {
  return (labels_key.empty() ? std::string() : "--set 'scene." + labels_key + "=\"\"' ") + "--set " +
         shell_word("scene.labels.from={type: images, folder: \"" + label.parent_path().string() + "\", pattern: \"" +
                    label_pattern(frame, label) + "\"" + more + "}");
}

// Label images whose pixels are colours (`channels` above 1), with the setting that reads them.
void report_color_labels(const FrameInfo& frame, const std::string& path, int channels, const std::string& labels_key,
                         Diagnostics& diagnostics) {
  if (channels == 1) return;
  diagnostics.error(
      "labels.image.channels", frame_place(frame),
      fmt::format("label image '{}' has {} channels: it is a picture in colours, not one of class ids", path, channels),
      "read the classes from the colours of the class table with " +
          label_settings(frame, path, labels_key, ", kind: color"));
}

// Of a picture of what the colour camera sees, at any size. ScanNet's own sizes are off each other by half a percent.
void check_shape(const std::string& path, const ImageSize& size, const Camera& color, const std::string& place,
                 Diagnostics& diagnostics) {
  const double shape = static_cast<double>(size.width_px) * color.height_px / size.height_px / color.width_px;
  if (std::abs(shape - 1) < 0.02) return;
  diagnostics.error(
      "scene.image.aspect", place,
      fmt::format("'{}' is {} pixels, the colour image {}: another aspect ratio", path, size_of(size), size_of(color)),
      "export all images of a frame from the same camera");
}

}  // namespace

bool FrameFileCheck::present(const FrameInfo& frame, FrameFiles& files, Diagnostics& diagnostics) {
  tell_load_progress("checking", ++checked_, frames_);
  if (!present(frame, kColorImage, files.color, diagnostics)) return false;
  for (const Kind& kind : kKinds) {
    std::string& path = files.*kind.path;
    if (is_optional(kind.what) && !path.empty() && !present(frame, kind.what, path, diagnostics)) path.clear();
  }
  return true;
}

bool FrameFileCheck::present(const FrameInfo& frame, const char* what, const std::string& path,
                             Diagnostics& diagnostics) {
  if (is_there(path)) return true;
  left_out_[what].push_back(frame.name);
  if (missing_ == MissingFiles::skip) return false;
  const std::string other = same_with_other_extension(path);
  diagnostics.error(
      "scene.file.missing", frame_place(frame),
      std::string(what) + " '" + path + "' is missing" + (other.empty() ? "" : ", but there is '" + other + "'"),
      !other.empty()    ? "rename it, or write its name in the index"
      : has_drive(path) ? "the index names a drive of Windows: write the file's path from the folder of the index"
                        : "restore the file, drop the frame from the index, or leave out what is missing with --set "
                          "scene.missing=skip");
  return false;
}

ImageSize FrameFileCheck::check_headers(FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                                        Diagnostics& diagnostics) {
  ImageSize color;
  for (const Kind& kind : kKinds) {
    const std::string& path = files.*kind.path;
    if (path.empty()) continue;
    const bool is_depth = kind.path == &FrameFiles::depth, is_label = kind.path == &FrameFiles::label;
    const bool any_size = is_depth ? rules.depth == DepthGrid::picture : kind.shown && rules.labels_of_any_size;
    const bool own_lens = is_depth && (rules.depth == DepthGrid::apart || rules.depth == DepthGrid::same_place);
    const Camera camera = own_lens                  ? rules.depth_camera.camera
                          : kind.shown && !any_size ? shown_camera(frame)
                                                    : frame.camera;
    try {
      const ImageSize size = is_depth ? depth_size(path) : image_size(path);
      if (kind.path == &FrameFiles::color) {
        color = size;
        frame.orientation = size.orientation;
        if (size.orientation != 1) turned_.push_back(frame.name);
      }
      if (is_label && (any_size || same_size(size, camera)))
        report_color_labels(frame, path, size.channels, rules.labels_key, diagnostics);
      if (any_size) {
        check_shape(path, size, camera, frame_place(frame), diagnostics);
      } else if (!same_size(size, camera)) {
        OtherSize wrong = other_size(kind.what, path, size, camera);
        if (kind.shown && turned_by_quarter(frame.orientation)) {
          wrong.message += " turned as the image's EXIF orientation says (" + std::to_string(frame.orientation) + ")";
          wrong.remedy = kShownRemedy;
        } else if (kind.path == &FrameFiles::mask && turned_by_quarter(frame.orientation)) {
          wrong.remedy = "masks are of the pixels as stored, as COLMAP's are: turn them back";
        }
        if (is_label)
          wrong.remedy +=
              "; labels of another one are scaled with " + label_settings(frame, path, rules.labels_key, "");
        diagnostics.error(wrong.code, frame_place(frame), wrong.message, wrong.remedy);
      }
    } catch (const Error& e) {
      diagnostics.error(e.code(), frame_place(frame), (any_size ? "" : std::string(kind.what) + " ") + e.message(),
                        e.remedy());
    }
  }
  return color;
}

void FrameFileCheck::report(const std::string& source, std::size_t frames_left, Diagnostics& diagnostics) const {
  if (!turned_.empty())
    diagnostics.note(
        "scene.image.orientation", source,
        fmt::format("{} of {} images have an EXIF orientation by which viewers turn them; here pixels count as "
                    "they are stored, as cameras and masks of COLMAP do, and labels as drawn over the image as shown: "
                    "{}",
                    turned_.size(), frames_left, first_names(turned_)));
  if (missing_ == MissingFiles::error) return;
  std::size_t lost = 0;
  for (const auto& [what, names] : left_out_) {
    if (is_optional(what)) {
      diagnostics.note("scene.file.skipped", source,
                       fmt::format("{} of {} frames go without a {}, which is missing: {}", names.size(), frames_left,
                                   what, first_names(names)));
    } else {
      lost += names.size();
      diagnostics.note("scene.file.skipped", source,
                       fmt::format("{} frame{} left out, whose {} is missing: {}", names.size(),
                                   names.size() == 1 ? " is" : "s are", what, first_names(names)));
    }
  }
  if (lost > 0 && frames_left == 0)
    diagnostics.error("scene.file.missing", source, "the files of all " + std::to_string(lost) + " frames are missing",
                      "check the path");
}

FrameMasks::FrameMasks(const std::string& root, const std::string& folder)
    : root_(root), folder_(folder.empty() ? "" : (fs::path(root) / folder).string()) {}

void FrameMasks::add_to(FrameFiles& files) {
  ++images_;
  if (files.mask.empty() && !folder_.empty()) files.mask = in_folder(files.color);
  const fs::path image(files.color);
  const std::string beside = names_.of((image.parent_path() / (kMovingMask + image.stem().string() + ".png")).string());
  if (!is_file(beside)) return;
  files.moving = beside;
  ++moving_;
}

std::string FrameMasks::in_folder(const std::string& image) {
  ++asked_;
  const fs::path path(image);
  for (const fs::path& where : folders_like(folder_, path)) {
    for (const std::string& name : {path.stem().string(), path.filename().string()}) {
      for (const char* extension : {".png", ".jpg", ".jpeg"}) {
        const std::string file = names_.of((where / (name + extension)).string());
        std::error_code unknown;
        if (!is_file(file) || fs::equivalent(file, path, unknown)) continue;
        ++found_;
        images_of_[file].push_back(image);
        return file;
      }
    }
  }
  return "";
}

void FrameMasks::report(Diagnostics& diagnostics) const {
  if (moving_ > 0)
    diagnostics.note("scene.mask.moving", root_,
                     fmt::format("{} of {} images have a {}NAME.png next to them: what is not black in it is masked",
                                 moving_, images_, kMovingMask));
  if (folder_.empty()) {
    if (is_folder(fs::path(root_) / "masks"))
      diagnostics.note(
          "scene.mask.unread", root_,
          "there is a folder 'masks', which is not read; scene.masks: masks leaves out what is black in it");
    return;
  }
  for (const auto& [file, images] : images_of_) {
    if (images.size() < 2) continue;
    diagnostics.error("scene.mask.ambiguous", "'" + file + "'",
                      "is the mask of '" + images[0] + "' and of '" + images[1] + "' by its name",
                      "put masks into folders named like those of the images");
    break;
  }
  if (found_ == 0) {
    diagnostics.error("scene.mask.missing", folder_,
                      is_folder(folder_) ? "no mask for any image" : "the folder of masks is missing",
                      "name the masks as the images, with .png, or correct scene.masks");
  } else if (found_ < asked_) {
    diagnostics.note("scene.mask.missing", folder_,
                     fmt::format("{} of {} images have no mask: all of their pixels count", asked_ - found_, asked_));
  }
}

// The frames of a folder.

namespace {

// Names for frames, each given once: the stem of the image's path, whose separators may be Windows'; where another
// frame took it, its folder is added, then a number.
class FrameNames {
 public:
  std::string of(const std::string& image_path) {
    const fs::path path(with_slashes(image_path));
    std::string name = path.stem().string();
    if (next_.count(name) > 0) {
      name = (path.parent_path().filename() / path.stem()).string();
      for (char& c : name) c = c == '/' ? '_' : c;
    }
    const std::string base = name;
    while (next_.count(name) > 0) name = base + "_" + std::to_string(next_[base]++);
    next_.emplace(name, 2);
    return name;
  }

 private:
  std::map<std::string, int> next_;  // given names -> the number that the next of that name gets
};

// The class table `path`, or where that is empty classes.yaml, classes.yml, classes.csv or info_semantic.json in each
// folder in turn. With labels but without a table, and for a table that cannot be read, an error goes into
// `diagnostics` and the table is empty.
ClassTable load_class_file(std::string path, const std::vector<std::string>& folders, bool has_labels,
                           Diagnostics& diagnostics) {
  for (const std::string& folder : folders)
    for (const char* name : {"classes.yaml", "classes.yml", "classes.csv", "info_semantic.json"})
      if (path.empty() && is_file(fs::path(folder) / name)) path = (fs::path(folder) / name).string();
  try {
    if (!path.empty()) {
      ClassTable table = ClassTable::load(path);
      if (has_labels && table.empty())
        diagnostics.error("labels.classes.empty", path, "no classes in it", "write one {id, name} for each class");
      return table;
    }
  } catch (const Error& e) {
    const bool named = e.message().find(path) != std::string::npos;
    diagnostics.error(e.code(), named ? "" : path, e.message(), e.remedy());
    return {};
  }
  if (has_labels)
    diagnostics.error(
        "labels.classes.none", folders.front(),
        "labels without a class table: no classes.yaml, classes.csv or info_semantic.json in the scene's folder",
        "write classes.yaml there, with a line such as '- {id: 1, name: wall}' for each class, or name a table with "
        "--set scene.classes=FILE");
  return {};
}

void report_unlabelled(const std::string& folder, std::size_t labelled, std::size_t frames, Diagnostics& diagnostics) {
  if (labelled == 0 && frames > 0)
    diagnostics.error("labels.frames.missing", folder, "no label image for any frame",
                      "name them like the images, in the same folders, with .png");
  else if (labelled < frames)
    diagnostics.note("labels.frames.missing", folder,
                     fmt::format("{} of {} frames have no label image", frames - labelled, frames));
}

// The grid of a further channel; nothing but the header is read.
FrameChannelInfo channel_info(const std::string& name, const std::string& file) {
  constexpr std::int64_t kMostCells = 1 << 20;  // of one axis
  const std::vector<std::int64_t> shape = npy_shape(file);
  const bool fits = shape.size() == 3 &&
                    std::all_of(shape.begin(), shape.end(), [](std::int64_t n) { return n > 0 && n <= kMostCells; });
  if (!fits)
    throw Error(
        ErrorKind::data, "scene.channel.shape",
        "'" + file + "': the shape of a channel is [height, width, numbers of a cell], got " + shape_text(shape),
        "write a .npy with three axes");
  return {name, static_cast<std::int32_t>(shape[0]), static_cast<std::int32_t>(shape[1]),
          static_cast<std::int32_t>(shape[2])};
}

bool is_in(const std::vector<std::string>& list, std::string_view name) {
  return std::find(list.begin(), list.end(), name) != list.end();
}

}  // namespace

PosedPhotographs::PosedPhotographs(const PhotographParams& params, const std::string& config_dir)
    : params_(params),
      root_((fs::path(config_dir) / params.root).string()),
      class_file_(DatasetBuild{config_dir}.path_of(params.classes)),
      check_(params.missing) {}

std::string PosedPhotographs::folder() const {
  return fs::is_regular_file(root_) ? fs::path(root_).parent_path().string() : root_;
}

void PosedPhotographs::require(std::initializer_list<const char*> parts, const std::string& app) const {
  for (const char* part : parts) {
    const fs::path path = *part == '\0' ? fs::path(root_) : fs::path(root_) / part;
    if (is_there(path)) continue;
    throw Error(ErrorKind::no_input, "files.folder.missing", "'" + path.string() + "' is missing; it is part of " + app,
                "check scene.root; it names the folder of one export");
  }
}

SceneInfo PosedPhotographs::open(std::vector<PosedPhotograph> all, PhotographRules rules, Diagnostics& diagnostics) {
  rules_ = std::move(rules);
  rules_.read.unknown_labels = params_.unknown_labels;
  if (rules_.read.labels_key.empty()) rules_.read.labels_key = "label_dir";
  const std::string place_of_all = rules_.place.empty() ? root_ : rules_.place;
  const std::string poses = rules_.poses.empty() ? place_of_all : rules_.poses;
  const fs::path canonical = fs::weakly_canonical(root_);
  info_ = {};
  info_.opengl_files = rules_.opengl_files;
  info_.metric = rules_.metric;
  info_.tracked = rules_.tracked;
  info_.name = (fs::is_regular_file(canonical) ? canonical.parent_path() : canonical).filename().string();
  photos_.clear();
  FrameNames names;
  FileNames finder;
  CameraFit sizes;
  FrameMasks masks(folder(), params_.masks);
  const bool has_label_dir = rules_.labels_by_name && !params_.label_dir.empty();
  std::vector<std::string> skipped;
  std::size_t labelled = 0;
  std::vector<PosedPhotograph> photos;
  for (std::size_t i = 0; i < all.size(); i += static_cast<std::size_t>(params_.every))
    photos.push_back(std::move(all[i]));
  check_.expect(photos.size());
  for (std::size_t i = 0; i < photos.size(); ++i) {
    PosedPhotograph& photo = photos[i];
    FrameInfo frame;
    const std::string& name = photo.name.empty() ? photo.color : photo.name;
    frame.name = names.of(name);
    frame.source = photo.color;
    frame.split = photo.split.value_or(HoldOut{params_.test_every}.split_of(i, photos.size()));
    frame.world_from_camera = photo.world_from_camera;
    frame.camera = photo.camera;
    const std::string place = frame_place(frame), of_pose = photo.place.empty() ? place : photo.place;
    if (!photo.matrix.empty()) {
      if (!check_last_row(photo.matrix, of_pose, diagnostics)) continue;
      frame.world_from_camera = pose_from_rows(photo.matrix);
      if (rules_.opengl_files) frame.world_from_camera = opencv_from_opengl(frame.world_from_camera);
    }
    const PoseState state = check_pose(frame.world_from_camera, of_pose, diagnostics);
    if (state == PoseState::not_finite) skipped.push_back(frame.name);
    photo.depth = finder.of(photo.depth);
    if (rules_.with_masks) masks.add_to(photo);
    if (has_label_dir) {
      const fs::path as_image = photo.name.empty() ? fs::path(name).filename() : fs::path(name);
      const std::string label =
          finder.of((fs::path(root_) / params_.label_dir / as_image).replace_extension(".png").string());
      if (is_there(label)) photo.label = label;
    }
    if (state != PoseState::good || !check_.present(frame, photo, diagnostics) ||
        (photo.find_camera && !photo.find_camera(place, frame.camera)))
      continue;
    if (photo.intrinsics != Intrinsics::exact &&
        (!sizes.fit(photo.color, place, frame.camera, diagnostics) ||
         (photo.intrinsics == Intrinsics::stated && !check_principal_point(frame.camera, place, diagnostics)) ||
         !check_camera(frame.camera, place, diagnostics)))
      continue;
    photo.tell_channels(frame);
    labelled += frame.has_labels ? 1 : 0;
    const std::int32_t colors = check_.check_headers(frame, photo, rules_.read, diagnostics).channels;
    if ((colors == 2 || colors == 4) && rules_.read.alpha_background >= 0 &&
        !photo.channels.contains(std::string(kAlphaChannel)))
      frame.channels.push_back(alpha_info(frame.camera));
    for (const auto& channel : photo.channels)
      noting(diagnostics, place, [&] { frame.channels.push_back(channel_info(channel.first, channel.second)); });
    info_.frames.push_back(std::move(frame));
    photo.confidence = finder.of(photo.confidence);
    photo.find_camera = {};  // it may look at what ends with this call
    photos_.push_back(std::move(photo));
  }
  sizes.report(place_of_all, diagnostics);
  if (rules_.with_masks) masks.report(diagnostics);
  check_.report(place_of_all, info_.frames.size(), diagnostics);
  report_skipped(skipped, info_.frames.size(), poses, diagnostics);
  if (has_label_dir)
    report_unlabelled((fs::path(root_) / params_.label_dir).string(), labelled, info_.frames.size(), diagnostics);
  const std::string class_file = class_file_.empty() ? rules_.class_file : class_file_;
  if (rules_.classes) {
    info_.classes = *rules_.classes;
  } else if (class_file.empty() && !rules_.class_list.empty()) {
    noting(diagnostics, root_ + ": 'classes'", [&] { info_.classes = ClassTable(rules_.class_list); });
  } else {
    const std::vector<std::string> usual{folder()};
    info_.classes = load_class_file(class_file, rules_.class_folders.empty() ? usual : rules_.class_folders,
                                    labelled > 0, diagnostics);
  }
  return info_;
}

void PosedPhotographs::read(int frame, FrameBuffer& out) const {
  const auto i = static_cast<std::size_t>(frame);
  const FrameInfo& info = info_.frames.at(i);
  const PosedPhotograph& photo = photos_[i];
  const std::vector<std::string> wanted = out.wanted;
  FrameReadRules rules = rules_.read;
  if (const double unit = rules_.depth_unit_m > 0 ? rules_.depth_unit_m : photo.depth_unit_m; unit > 0)
    rules.depth_unit_m = unit;
  rules.alpha = is_in(wanted, kAlphaChannel) && !photo.channels.contains(std::string(kAlphaChannel));
  if (params_.least_confidence != Confidence::low && !photo.confidence.empty() && is_there(photo.confidence)) {
    rules.confidence = photo.confidence;
    rules.least = params_.least_confidence == Confidence::high ? photo.high : 1;
  }
  read_frame_files(info, photo, rules, info_.classes, out);
  for (const FrameChannelInfo& told : info.channels) {
    if (!is_in(wanted, told.name) || (told.name == kAlphaChannel && rules.alpha)) continue;
    NumpyArray array = read_npy(photo.channels.at(told.name), [](std::span<const std::int64_t>) {});
    out.channels.push_back({told.name, told.height, told.width, told.cols, std::move(array.values)});
  }
}

}  // namespace semfield
