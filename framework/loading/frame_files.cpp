// Frames kept as image files.
#include "loading/frame_files.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <iterator>
#include <limits>

#include "core/check.h"
#include "core/error.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "formats/text_rows.h"
#include "loading/frame_source.h"
#include "loading/posed_photographs.h"
#include "scene/scene.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

// What the name of a mask of moving things begins with, beside its image [instant-ngp].
constexpr const char* kMovingMask = "dynamic_mask_";

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

// The size of a label or instance image, which is drawn over the picture as viewers show it.
Camera shown_camera(const FrameInfo& frame) {
  Camera camera = frame.camera;
  if (turned_by_quarter(frame.orientation)) std::swap(camera.width_px, camera.height_px);
  return camera;
}

template <class T>
void check_size(const Image<T>& image, const Camera& camera, const std::string& path) {
  if (image.width_px == camera.width_px && image.height_px == camera.height_px) return;
  throw Error(ErrorKind::data, "scene.image.size",
              "'" + path + "' is " + size_text(image.width_px, image.height_px) + " pixels, the camera " +
                  size_text(camera.width_px, camera.height_px),
              "colour, depth and labels of a frame need the size that its camera states");
}

// Ids of the pixels as the colour image stores them.
Image<std::uint16_t> read_shown_ids(const FrameInfo& frame, const std::string& path) {
  Image<std::uint16_t> image = read_ids(path);
  check_size(image, shown_camera(frame), path);
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
  diagnostics.error("labels.image.channels", frame_place(frame),
                    "label image '" + path + "' has " + std::to_string(channels) +
                        " channels: it is a picture in colours, not one of class ids",
                    "read the classes from the colours of the class table with " +
                        label_settings(frame, path, labels_key, ", kind: color"));
}

// The pixels that a mask lets count [H * W], 0 = masked: those that are not black, or, of a JPEG, whose blacks are not
// exact, not dark.
Image<std::uint8_t> read_mask(const std::string& path) {
  const Image<std::uint8_t> image = read_rgb(path);
  const std::string extension = fs::path(path).extension().string();
  const std::uint8_t least = extension == ".jpg" || extension == ".jpeg" ? 128 : 1;
  Image<std::uint8_t> out{image.width_px, image.height_px, 1, std::vector<std::uint8_t>(image.pixels.size() / 3)};
  for (std::size_t i = 0; i < out.pixels.size(); ++i) {
    const std::uint8_t* const p = &image.pixels[3 * i];
    out.pixels[i] = std::max({p[0], p[1], p[2]}) >= least ? 1 : 0;
  }
  return out;
}

}  // namespace

void require_folder(const fs::path& folder, const std::string& remedy) {
  if (!fs::is_directory(folder))  // which throws for what cannot be looked at, and so is not missing
    throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + folder.string() + "' is missing", remedy);
}

std::string ending_of(const std::string& path) {
  std::string out = fs::path(path).extension().string();
  for (char& c : out) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return out;
}

std::vector<std::string> files_with(const std::string& folder, std::span<const std::string_view> extensions) {
  std::vector<std::string> found;
  if (!is_folder(folder)) return found;
  for (const fs::directory_entry& entry : sorted_folder(folder)) {
    if (entry.path().filename().string().starts_with(kMovingMask)) continue;
    if (std::find(extensions.begin(), extensions.end(), ending_of(entry.path().string())) != extensions.end())
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

void report_unlabelled(const std::string& folder, std::size_t labelled, std::size_t frames, Diagnostics& diagnostics) {
  if (labelled == 0 && frames > 0) {
    diagnostics.error("labels.frames.missing", folder, "no label image for any frame",
                      "name them like the images, in the same folders, with .png");
  } else if (labelled < frames) {
    diagnostics.note(
        "labels.frames.missing", folder,
        std::to_string(frames - labelled) + " of " + std::to_string(frames) + " frames have no label image");
  }
}

std::map<std::int64_t, std::string> numbered_photographs(const std::string& folder, Diagnostics& diagnostics) {
  std::map<std::int64_t, std::string> out;
  for (const std::string& path : files_with(folder, kPhotographs)) {
    std::int64_t number = 0;
    if (!parse_whole(fs::path(path).stem().string(), number) || number < 0 || number > 1'000'000'000) {
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

ImageSize FrameFileCheck::check_headers(FrameInfo& frame, const FrameFiles& files, Diagnostics& diagnostics,
                                        const DepthCamera* depth_camera) {
  ImageSize color;
  for (const Kind& kind : kKinds) {
    const std::string& path = files.*kind.path;
    if (path.empty()) continue;
    const bool is_depth = kind.path == &FrameFiles::depth, is_label = kind.path == &FrameFiles::label;
    const Camera camera = is_depth && depth_camera != nullptr ? depth_camera->camera
                          : kind.shown                        ? shown_camera(frame)
                                                              : frame.camera;
    try {
      const ImageSize size = is_depth ? depth_size(path) : image_size(path);
      if (kind.path == &FrameFiles::color) {
        color = size;
        frame.orientation = size.orientation;
        if (size.orientation != 1) turned_.push_back(frame.name);
      }
      if (size.width_px != camera.width_px || size.height_px != camera.height_px) {
        OtherSize wrong = other_size(kind.what, path, size, camera);
        if (kind.shown && turned_by_quarter(frame.orientation)) {
          wrong.message += " turned as the image's EXIF orientation says (" + std::to_string(frame.orientation) + ")";
          wrong.remedy = kShownRemedy;
        } else if (kind.path == &FrameFiles::mask && turned_by_quarter(frame.orientation)) {
          wrong.remedy = "masks are of the pixels as stored, as COLMAP's are: turn them back";
        }
        if (is_label)
          wrong.remedy += "; labels of another one are scaled with " + label_settings(frame, path, labels_key_, "");
        diagnostics.error(wrong.code, frame_place(frame), wrong.message, wrong.remedy);
      } else if (is_label) {
        report_color_labels(frame, path, size.channels, labels_key_, diagnostics);
      }
    } catch (const Error& e) {
      diagnostics.error(e.code(), frame_place(frame), std::string(kind.what) + " " + e.message(), e.remedy());
    }
  }
  return color;
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

void read_frame_files(const FrameInfo& frame, const FrameFiles& files, const FrameReadRules& rules,
                      const ClassTable& classes, FrameBuffer& out) {
  try {
    out = {};
    out.width_px = frame.camera.width_px;
    out.height_px = frame.camera.height_px;
    std::vector<std::uint8_t> alpha;
    const bool wants_alpha = rules.alpha || rules.alpha_masks;
    Image<std::uint8_t> color = read_rgb(files.color, rules.alpha_background, wants_alpha ? &alpha : nullptr);
    check_size(color, frame.camera, files.color);
    out.rgb = std::move(color.pixels);
    for (const auto& [path, masked] : {std::pair{&files.mask, 0}, std::pair{&files.moving, 1}}) {
      if (path->empty()) continue;
      const Image<std::uint8_t> mask = read_mask(*path);
      check_size(mask, frame.camera, *path);
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
        check_size(depth, frame.camera, files.depth);
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
  for (const std::string& folder : folders) {
    for (const char* name : {"classes.yaml", "classes.yml", "classes.csv", "info_semantic.json"}) {
      const fs::path path = fs::path(folder) / name;
      if (is_file(path)) return path.string();
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
  if (is_there(path)) return path;
  const std::string slashed = with_slashes(path);
  const bool ascii = std::all_of(slashed.begin(), slashed.end(), [](char c) { return (c & 0x80) == 0; });
  if (ascii || is_there(slashed)) return slashed;
  fs::path found;
  for (const fs::path& part : fs::path(slashed)) {
    const fs::path next = found / part;
    if (is_there(next.string())) {
      found = next;
      continue;
    }
    const std::string* const other = looks_like(found.string(), part.string());
    if (other == nullptr) return slashed;
    found /= *other;
  }
  return found.string();
}

namespace {

// [height, width] of the array, whose other axes have one place.
std::vector<std::int64_t> plane_of(std::span<const std::int64_t> shape) {
  std::vector<std::int64_t> plane;
  for (const std::int64_t axis : shape)
    if (axis != 1 || shape.size() == 2) plane.push_back(axis);
  if (plane.size() != 2)
    throw Error(ErrorKind::data, "scene.depth.shape", "the shape is " + shape_text(shape),
                "save depth as an array [height, width]");
  check_image_limits(plane[1], plane[0], 1, sizeof(float));
  return plane;
}

Image<float> read_depth_array(const std::string& path, double unit_m) {
  const NumpyValues array = read_npy_values(path, [](std::span<const std::int64_t> shape) { (void)plane_of(shape); });
  const std::vector<std::int64_t> plane = plane_of(array.shape);
  Image<float> out{static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, {}};
  out.pixels.reserve(array.values.size());
  const double ceiling = array.is_whole && array.element_bytes == 2 ? 65535 : std::numeric_limits<float>::max();
  for (const double value : array.values)
    out.pixels.push_back(value > 0 && value < ceiling ? static_cast<float>(value * (array.is_whole ? unit_m : 1)) : 0);
  return out;
}

}  // namespace

// A TIFF holds integers or real numbers, which have 32 bits.
bool has_real_depth(const std::string& path) {
  const std::string ending = ending_of(path);
  if (ending == ".npy") return !npy_is_whole(path);
  if (ending == ".tif" || ending == ".tiff") return image_size(path).bits > 16;
  return ending == ".exr" || ending == ".pfm";
}

ImageSize depth_size(const std::string& path) {
  if (ending_of(path) != ".npy") return image_size(path);
  return naming(path, [&]() -> ImageSize {
    const std::vector<std::int64_t> plane = plane_of(npy_shape(path));
    return {static_cast<std::int32_t>(plane[1]), static_cast<std::int32_t>(plane[0]), 1, 32};
  });
}

Image<float> read_depth(const std::string& path, double unit_m) {
  if (ending_of(path) == ".npy") return read_depth_array(path, unit_m);
  if (has_real_depth(path)) {
    Image<float> out = read_float(path);
    for (float& d : out.pixels)
      if (!std::isfinite(d) || d < 0) d = 0;
    return out;
  }
  const Image<std::uint16_t> image = read_ids(path);
  Image<float> out{image.width_px, image.height_px, 1, std::vector<float>(image.pixels.size())};
  for (std::size_t i = 0; i < out.pixels.size(); ++i)
    out.pixels[i] = image.pixels[i] == 65535 ? 0.0f : static_cast<float>(image.pixels[i] * unit_m);
  return out;
}

namespace {

constexpr double kEdge = 0.04;    // relative step of depth between neighbours
constexpr double kWidest = 1000;  // pixels of the colour image that a facet covers at most: beyond, the lens folds

struct Corner {
  double u = 0, v = 0, depth = 0;  // in the colour image; depth 0: not seen there
  double taken = 0;                // as the depth camera took it
};

// Draws pixel centres within the triangle; inverse depth is linear in the image of a pinhole.
void draw_triangle(Image<float>& out, const Corner& a, const Corner& b, const Corner& c) {
  const double least = std::min({a.taken, b.taken, c.taken}), most = std::max({a.taken, b.taken, c.taken});
  if (!(least > 0) || !(a.depth > 0) || !(b.depth > 0) || !(c.depth > 0) || most - least > kEdge * least) return;
  const double area = (b.u - a.u) * (c.v - a.v) - (c.u - a.u) * (b.v - a.v);
  const double u0 = std::min({a.u, b.u, c.u}), u1 = std::max({a.u, b.u, c.u});
  const double v0 = std::min({a.v, b.v, c.v}), v1 = std::max({a.v, b.v, c.v});
  if (area == 0 || !(u1 - u0 < kWidest) || !(v1 - v0 < kWidest)) return;
  const auto first = [](double at) { return std::max(0.0, std::ceil(at - 0.5)); };
  const auto last = [](double at, std::int32_t size) { return std::min(size - 1.0, std::floor(at - 0.5)); };
  for (double y = first(v0); y <= last(v1, out.height_px); ++y) {
    for (double x = first(u0); x <= last(u1, out.width_px); ++x) {
      const double u = x + 0.5, v = y + 0.5;
      const double wb = ((u - a.u) * (c.v - a.v) - (c.u - a.u) * (v - a.v)) / area;
      const double wc = ((b.u - a.u) * (v - a.v) - (u - a.u) * (b.v - a.v)) / area;
      if (wb < -1e-9 || wc < -1e-9 || wb + wc > 1 + 1e-9) continue;
      const double at = 1 / ((1 - wb - wc) / a.depth + wb / b.depth + wc / c.depth);
      float& here = out.pixels[pixel_at(static_cast<std::int64_t>(x), static_cast<std::int64_t>(y), out.width_px)];
      if (here == 0 || at < static_cast<double>(here)) here = static_cast<float>(at);
    }
  }
}

}  // namespace

std::vector<float> drawn_depth(const Image<float>& depth, const DepthCamera& from, const Camera& color) {
  SEMFIELD_CHECK(depth.width_px == from.camera.width_px && depth.height_px == from.camera.height_px,
                 "the depth image has another size than its camera");
  const auto corner = [&](std::int32_t x, std::int32_t y) {
    Corner out;
    const auto taken = static_cast<double>(depth.at(x, y));
    const Vec3d ray = from.camera.direction(x + 0.5, y + 0.5);
    const double per_distance = from.camera.depth_of(ray);
    if (!(taken > 0) || !(per_distance > 0)) return out;
    const Vec3d p = from.depth_from_color.apply_inverse(ray * (taken / per_distance));
    if (!color.sees(p) || !color.is_within_lens(p)) return out;
    color.project(p, out.u, out.v);
    out.depth = color.depth_of(p);
    out.taken = taken;
    return out;
  };
  Image<float> out{color.width_px, color.height_px, 1,
                   std::vector<float>(pixel_at(0, color.height_px, color.width_px))};
  std::vector<Corner> above, row;
  for (std::int32_t y = 0; y < depth.height_px; ++y) {
    row.clear();
    for (std::int32_t x = 0; x < depth.width_px; ++x) row.push_back(corner(x, y));
    for (std::size_t x = 0; y > 0 && x + 1 < row.size(); ++x) {
      const std::array<const Corner*, 4> quad{&above[x], &above[x + 1], &row[x + 1], &row[x]};
      // Along the diagonal whose ends are nearer to each other in depth; with a corner missing, what is left.
      const bool falling = std::abs(quad[0]->taken - quad[2]->taken) <= std::abs(quad[1]->taken - quad[3]->taken);
      const std::size_t turn =
          (quad[1]->taken > 0 && quad[3]->taken > 0 && (!falling || quad[0]->taken == 0 || quad[2]->taken == 0)) ? 1
                                                                                                                 : 0;
      const auto at = [&](std::size_t k) -> const Corner& { return *quad[(k + turn) % 4]; };
      draw_triangle(out, at(0), at(1), at(2));
      draw_triangle(out, at(0), at(2), at(3));
    }
    above.swap(row);
  }
  return std::move(out.pixels);
}

std::vector<fs::path> folders_like(const fs::path& folder, const fs::path& image) {
  std::vector<fs::path> tails, singles;
  fs::path tail;
  for (fs::path at = image.parent_path(); tails.size() < 3 && at.has_filename(); at = at.parent_path()) {
    tail = tail.empty() ? at.filename() : at.filename() / tail;
    if (!tails.empty()) singles.push_back(folder / at.filename());
    tails.insert(tails.begin(), folder / tail);
  }
  tails.insert(tails.end(), singles.begin(), singles.end());
  tails.push_back(folder);
  return tails;
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
                     std::to_string(moving_) + " of " + std::to_string(images_) + " images have a " + kMovingMask +
                         "NAME.png next to them: what is not black in it is masked");
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
                      "put masks into folders called as those of the images");
    break;
  }
  if (found_ == 0) {
    diagnostics.error("scene.mask.missing", folder_,
                      is_folder(folder_) ? "no mask for any image" : "the folder of masks is missing",
                      "name the masks as the images, with .png, or correct scene.masks");
  } else if (found_ < asked_) {
    diagnostics.note("scene.mask.missing", folder_,
                     std::to_string(asked_ - found_) + " of " + std::to_string(asked_) +
                         " images have no mask: all of their pixels count");
  }
}

}  // namespace semfield
