// Frames kept as image files.
#include "loading/frame_files.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <iterator>

#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "loading/depth_images.h"
#include "loading/frame_source.h"
#include "loading/posed_photographs.h"
#include "scene/scene.h"
#include "scene/scene_checks.h"
#include "system/files.h"

namespace semfield {

namespace {

bool is_there(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::exists(path, ignored);
}

// Channels that a frame can do without.
constexpr std::pair<const char*, std::string FrameFiles::*> kOptional[] = {
    {"depth image", &FrameFiles::depth},
    {"label image", &FrameFiles::label},
    {"instance image", &FrameFiles::instance},
    {"mask", &FrameFiles::mask},
    {"mask of moving things", &FrameFiles::moving}};

bool is_optional(const std::string& what) {
  return std::any_of(std::begin(kOptional), std::end(kOptional), [&](const auto& one) { return what == one.first; });
}

// "a, b, c, ..."
std::string first_names(const std::vector<std::string>& names) {
  constexpr std::size_t kNamed = 8;
  if (names.size() <= kNamed) return join(names);
  return join({names.begin(), names.begin() + kNamed}) + ", ...";
}

// A picture beside `path` that is called like it up to the extension; "" when there is none.
std::string same_with_other_extension(const std::filesystem::path& path) {
  for (const char* extension : {".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".exr"}) {
    const std::string other = std::filesystem::path(path).replace_extension(extension).string();
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
std::string label_pattern(const FrameInfo& frame, const std::filesystem::path& label) {
  const std::string stem = label.stem().string(), extension = label.extension().string();
  if (stem == frame.name) return "{name}" + extension;
  if (stem == std::filesystem::path(frame.source).stem().string()) return "{stem}" + extension;
  const std::size_t digits = stem.find_last_not_of("0123456789") + 1;
  const std::size_t own = frame.name.find_last_not_of("0123456789") + 1;
  if (digits < stem.size() && own < frame.name.size()) return stem.substr(0, digits) + "{number}" + extension;
  return "{name}" + extension;
}

// The size of a label or instance image, which is drawn over the picture as viewers show it.
Camera shown_camera(const FrameInfo& frame) {
  Camera camera = frame.camera;
  if (turned_by_quarter(frame.orientation)) std::swap(camera.width_px, camera.height_px);
  return camera;
}

template <class T>
void check_size(const Image<T>& image, const FrameInfo& frame, const std::string& path) {
  if (image.width_px == frame.camera.width_px && image.height_px == frame.camera.height_px) return;
  throw Error(ErrorKind::data, "scene.image.size",
              "'" + path + "' is " + size_text(image.width_px, image.height_px) + " pixels, the camera " +
                  size_text(frame.camera.width_px, frame.camera.height_px),
              "colour, depth and labels of a frame need the size that its camera states");
}

// Ids of the pixels as the colour image stores them.
Image<std::uint16_t> read_shown_ids(const FrameInfo& frame, const std::string& path) {
  Image<std::uint16_t> image = read_ids(path);
  FrameInfo shown = frame;
  shown.camera = shown_camera(frame);
  check_size(image, shown, path);
  const Camera& camera = frame.camera;
  return {camera.width_px, camera.height_px, 1,
          as_stored(std::move(image.pixels), camera.width_px, camera.height_px, frame.orientation)};
}

void read_labels(const FrameInfo& frame, const std::string& path, bool unknown_void, const ClassTable& classes,
                 std::vector<std::int16_t>& out) {
  const Image<std::uint16_t> image = read_shown_ids(frame, path);
  out.resize(image.pixels.size());
  UnknownValues unknown;
  for (std::size_t i = 0; i < out.size(); ++i) {
    const int index = classes.index_of(image.pixels[i]);
    if (index == -2 && !unknown_void) unknown.try_emplace(std::to_string(image.pixels[i]), i);
    out[i] = index < 0 ? kVoid : static_cast<std::int16_t>(index);
  }
  if (!unknown.empty())
    throw UnknownLabelError("label id", std::move(unknown), path, image.width_px, kUnknownLabelRemedy);
}

// Settings that read this file as one of label files in place of the scene's own; `more` are further keys.
std::string label_settings(const FrameInfo& frame, const std::filesystem::path& label, const std::string& labels_key,
                           const std::string& more) {
  return (labels_key.empty() ? std::string() : "--set 'scene." + labels_key + "=\"\"' ") + "--set " +
         shell_word("scene.labels.from={type: images, folder: \"" + label.parent_path().string() + "\", pattern: \"" +
                    label_pattern(frame, label) + "\"" + more + "}");
}

}  // namespace

std::vector<std::string> files_with(const std::string& folder, std::span<const std::string_view> extensions) {
  std::vector<std::string> found;
  std::error_code unknown;
  if (!std::filesystem::is_directory(folder, unknown)) return found;
  for (const std::filesystem::directory_entry& entry : sorted_folder(folder)) {
    if (entry.path().filename().string().starts_with(kMovingMask)) continue;
    std::string extension = entry.path().extension().string();
    for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    if (std::find(extensions.begin(), extensions.end(), extension) != extensions.end())
      found.push_back(entry.path().string());
  }
  return found;
}

// ScanNet's own sizes are off each other by half a percent.
void check_shape(const std::string& path, const FrameInfo& frame, const std::string& labels_key,
                 Diagnostics& diagnostics) {
  if (path.empty()) return;
  const Camera& color = frame.camera;
  const std::string place = frame_place(frame);
  try {
    const ImageSize size = depth_size(path);
    if (!labels_key.empty()) report_color_labels(frame, path, size.channels, labels_key, diagnostics);
    const double shape = static_cast<double>(size.width_px) * color.height_px / size.height_px / color.width_px;
    if (std::abs(shape - 1) < 0.02) return;
    diagnostics.error("scene.image.aspect", place,
                      "'" + path + "' is " + size_text(size.width_px, size.height_px) + " pixels, the colour image " +
                          size_text(color.width_px, color.height_px) + ": another aspect ratio",
                      "export all images of a frame from the same camera");
  } catch (const Error& e) {
    diagnostics.error(e.code(), place, e.message(), e.remedy());
  }
}

void report_no_labels(const std::string& folder, Diagnostics& diagnostics) {
  diagnostics.error("labels.frames.missing", folder, "no label image for any frame",
                    "name them like the images, with .png");
}

Image<std::uint8_t> read_mask(const std::string& path) {
  const Image<std::uint8_t> image = read_rgb(path);
  const std::string extension = std::filesystem::path(path).extension().string();
  const std::uint8_t least = extension == ".jpg" || extension == ".jpeg" ? 128 : 1;
  Image<std::uint8_t> out{image.width_px, image.height_px, 1, std::vector<std::uint8_t>(image.pixels.size() / 3)};
  for (std::size_t i = 0; i < out.pixels.size(); ++i) {
    const std::uint8_t* const p = &image.pixels[3 * i];
    out.pixels[i] = std::max({p[0], p[1], p[2]}) >= least ? 1 : 0;
  }
  return out;
}

std::map<std::int64_t, std::string> numbered_photographs(const std::string& folder, Diagnostics& diagnostics) {
  std::map<std::int64_t, std::string> out;
  for (const std::string& path : files_with(folder, kPhotographs)) {
    std::int64_t number = 0;
    if (!parse_whole(std::filesystem::path(path).stem().string(), number) || number < 0 || number > 1'000'000'000) {
      diagnostics.error("scene.frame.name", "'" + path + "'", "the name is not a frame's number",
                        "name colour images <id>.jpg or <id>.png");
    } else if (const auto [other, fresh] = out.emplace(number, path); !fresh) {
      diagnostics.error("scene.frame.twice", "'" + path + "'", "is the same frame as '" + other->second + "'",
                        "keep one of the two");
    }
  }
  return out;
}

bool FrameFileCheck::present(const FrameInfo& frame, FrameFiles& files, Diagnostics& diagnostics) {
  tell_load_progress("checking", ++checked_, frames_);
  if (!present(frame, kColorImage, files.color, diagnostics)) return false;
  for (const auto& [what, path] : kOptional) {
    if (!(files.*path).empty() && !present(frame, what, files.*path, diagnostics)) (files.*path).clear();
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

ImageSize FrameFileCheck::check_headers(FrameInfo& frame, const FrameFiles& files, Diagnostics& diagnostics,
                                        const DepthCamera* depth_camera) {
  const ImageSize color = check_header(frame, kColorImage, files.color, frame.camera, diagnostics);
  if (!files.color.empty()) frame.orientation = color.orientation;
  for (const auto& [what, path] : kOptional) {
    const bool apart = depth_camera != nullptr && path == &FrameFiles::depth;
    const bool is_drawn = path == &FrameFiles::label || path == &FrameFiles::instance;
    check_header(frame, what, files.*path,
                 apart      ? depth_camera->camera
                 : is_drawn ? shown_camera(frame)
                            : frame.camera,
                 diagnostics);
  }
  return color;
}

ImageSize FrameFileCheck::check_header(const FrameInfo& frame, const char* what, const std::string& path,
                                       const Camera& camera, Diagnostics& diagnostics) {
  ImageSize size;
  if (path.empty()) return size;
  const bool is_label = what == kOptional[1].first, is_drawn = is_label || what == kOptional[2].first;
  try {
    size = what == kOptional[0].first ? depth_size(path) : image_size(path);
    if (what == kColorImage && size.orientation != 1) turned_.push_back(frame.name);
    if (size.width_px != camera.width_px || size.height_px != camera.height_px) {
      OtherSize wrong = other_size(what, path, size, camera);
      if (is_drawn && turned_by_quarter(frame.orientation)) {
        wrong.message += " turned as the image's EXIF orientation says (" + std::to_string(frame.orientation) + ")";
        wrong.remedy = kShownRemedy;
      } else if (what == kOptional[3].first && turned_by_quarter(frame.orientation)) {
        wrong.remedy = "masks are of the pixels as stored, as COLMAP's are: turn them back";
      }
      diagnostics.error(wrong.code, frame_place(frame), wrong.message,
                        is_label ? wrong.remedy + "; labels of another one are scaled with " +
                                       label_settings(frame, path, labels_key_, "")
                                 : wrong.remedy);
    } else if (is_label) {
      report_color_labels(frame, path, size.channels, labels_key_, diagnostics);
    }
  } catch (const Error& e) {
    diagnostics.error(e.code(), frame_place(frame), std::string(what) + " " + e.message(), e.remedy());
  }
  return size;
}

void FrameFileCheck::report(const std::string& source, std::size_t frames_left, Diagnostics& diagnostics) const {
  if (!turned_.empty()) {
    diagnostics.note(
        "scene.image.orientation", source,
        std::to_string(turned_.size()) + " of " + std::to_string(frames_left) +
            " images have an EXIF orientation by which viewers turn them; here pixels count as "
            "they are stored, as cameras and masks of COLMAP do, and labels as drawn over the image as shown: " +
            first_names(turned_));
  }
  if (missing_ == MissingFiles::error) return;
  std::size_t lost = 0;
  for (const auto& [what, names] : left_out_) {
    const std::string count = std::to_string(names.size());
    if (is_optional(what)) {
      diagnostics.note("scene.file.skipped", source,
                       count + " of " + std::to_string(frames_left) + " frames go without a " + what +
                           ", which is missing: " + first_names(names));
    } else {
      lost += names.size();
      diagnostics.note("scene.file.skipped", source,
                       count + (names.size() == 1 ? " frame is" : " frames are") + " left out, whose " + what +
                           " is missing: " + first_names(names));
    }
  }
  if (lost > 0 && frames_left == 0)
    diagnostics.error("scene.file.missing", source, "the files of all " + std::to_string(lost) + " frames are missing",
                      "check the path");
}

void report_color_labels(const FrameInfo& frame, const std::string& path, int channels, const std::string& labels_key,
                         Diagnostics& diagnostics) {
  if (channels == 1) return;
  diagnostics.error("labels.image.channels", frame_place(frame),
                    "label image '" + path + "' has " + std::to_string(channels) +
                        " channels: it is a picture in colours, not one of class ids",
                    "read the classes from the colours of the class table with " +
                        label_settings(frame, path, labels_key, ", kind: color"));
}

void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out) {
  try {
    out = {};
    out.width_px = frame.camera.width_px;
    out.height_px = frame.camera.height_px;
    std::vector<std::uint8_t> alpha;
    const bool wants_alpha = rules.alpha || rules.alpha_masks;
    Image<std::uint8_t> color = read_rgb(files.color, rules.alpha_background, wants_alpha ? &alpha : nullptr);
    check_size(color, frame, files.color);
    out.rgb = std::move(color.pixels);
    for (const auto& [path, masked] : {std::pair{&files.mask, 0}, std::pair{&files.moving, 1}}) {
      if (path->empty()) continue;
      const Image<std::uint8_t> mask = read_mask(*path);
      check_size(mask, frame, *path);
      if (out.used.empty()) out.used.assign(mask.pixels.size(), 1);
      for (std::size_t i = 0; i < out.used.size(); ++i) out.used[i] = mask.pixels[i] == masked ? 0 : out.used[i];
    }
    if (rules.alpha_masks && std::any_of(alpha.begin(), alpha.end(), [](std::uint8_t a) { return a != 255; })) {
      if (out.used.empty()) out.used.assign(alpha.size(), 1);
      for (std::size_t i = 0; i < alpha.size(); ++i) out.used[i] = alpha[i] == 255 ? out.used[i] : 0;
    }
    if (rules.alpha) out.channels.push_back(alpha_channel(color.width_px, color.height_px, alpha));
    if (!files.depth.empty()) {
      Image<float> depth = read_depth(files.depth, rules.depth_unit_m);
      if (rules.depth_camera != nullptr) {
        out.depth_m = drawn_depth(depth, *rules.depth_camera, frame.camera);
      } else {
        check_size(depth, frame, files.depth);
        out.depth_m = std::move(depth.pixels);
      }
    }
    if (!files.label.empty() && !classes.empty())
      read_labels(frame, files.label, rules.unknown_labels == UnknownLabels::as_void, classes, out.label);
    if (!files.instance.empty()) {
      const Image<std::uint16_t> image = read_shown_ids(frame, files.instance);
      out.instance.assign(image.pixels.begin(), image.pixels.end());
    }
  } catch (Error& e) {
    e.while_doing("frame '" + frame.name + "'");
    throw;  // not a copy: an UnknownLabelError stays one
  }
}

std::string find_class_file(const std::vector<std::string>& folders) {
  std::error_code ignored;
  for (const std::string& folder : folders) {
    for (const char* name : {"classes.yaml", "classes.yml", "classes.csv", "info_semantic.json"}) {
      const std::filesystem::path path = std::filesystem::path(folder) / name;
      if (std::filesystem::is_regular_file(path, ignored)) return path.string();
    }
  }
  return {};
}

ClassTable load_class_file(const std::string& path, const std::vector<std::string>& folders, bool has_labels,
                           Diagnostics& diagnostics) {
  const std::string found = path.empty() ? find_class_file(folders) : path;
  try {
    if (!found.empty()) {
      ClassTable table = ClassTable::load(found);
      if (has_labels && table.empty())
        diagnostics.error("labels.classes.empty", found, "no classes in it", "write one {id, name} for each class");
      return table;
    }
  } catch (const Error& e) {
    const bool named = e.message().find(found) != std::string::npos;
    diagnostics.error(e.code(), named ? "" : found, e.message(), e.remedy());
    return {};
  }
  if (has_labels) {
    diagnostics.error(
        "labels.classes.none", folders.front(),
        "labels without a class table: no classes.yaml, classes.csv or info_semantic.json in the scene's folder",
        "write classes.yaml there, with a line such as '- {id: 1, name: wall}' for each class, or name a table with "
        "--set "
        "scene.classes=FILE");
  }
  return {};
}

std::string FrameNames::of(const std::string& image_path) {
  const std::filesystem::path path(with_slashes(image_path));
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

namespace fs = std::filesystem;

namespace {

bool exists(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

}  // namespace

std::string with_slashes(std::string path) {
  std::replace(path.begin(), path.end(), '\\', '/');
  return path;
}

const std::string* FileNames::looks_like(const std::string& folder, const std::string& name) {
  const auto [found, fresh] = folders_.try_emplace(folder);
  if (fresh) {
    std::error_code unknown;
    for (fs::directory_iterator it(folder.empty() ? "." : folder, unknown), end; !unknown && it != end;
         it.increment(unknown)) {
      const std::string entry = it->path().filename().string();
      const auto [other, first] = found->second.emplace(decomposed(entry), entry);
      if (!first) other->second.clear();
    }
  }
  const auto entry = found->second.find(decomposed(name));
  return entry == found->second.end() || entry->second.empty() ? nullptr : &entry->second;
}

std::string FileNames::of(const std::string& path) {
  if (exists(path)) return path;
  const std::string slashed = with_slashes(path);
  const bool ascii = std::all_of(slashed.begin(), slashed.end(), [](char c) { return (c & 0x80) == 0; });
  if (ascii || exists(slashed)) return slashed;
  fs::path found;
  for (const fs::path& part : fs::path(slashed)) {
    const fs::path next = found / part;
    if (exists(next.string())) {
      found = next;
      continue;
    }
    const std::string* const other = looks_like(found.string(), part.string());
    if (other == nullptr) return slashed;
    found /= *other;
  }
  return found.string();
}

}  // namespace semfield
