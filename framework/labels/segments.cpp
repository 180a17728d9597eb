#include "labels/segments.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <set>
#include <span>

#include "compute/parallel.h"
#include "core/files.h"
#include "formats/image_io.h"
#include "formats/npz.h"
#include "formats/text_rows.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_json.h"

namespace semfield {

std::int32_t FrameSegments::at(std::int32_t column, std::int32_t row, std::int32_t frame_width,
                               std::int32_t frame_height) const {
  // The pixel that holds the centre of the frame's.
  const auto place = [](std::int64_t i, std::int64_t from, std::int64_t to) { return (2 * i + 1) * to / (2 * from); };
  const std::int64_t x = place(column, frame_width, width_px), y = place(row, frame_height, height_px);
  return id[static_cast<std::size_t>(y * width_px + x)];
}

std::int64_t SegmentSet::count() const {
  std::vector<std::int64_t> found(frames.size());
  parallel_for(std::ssize(frames), [&](std::int64_t f) {
    std::set<std::int32_t> ids(frames[static_cast<std::size_t>(f)].id.begin(),
                               frames[static_cast<std::size_t>(f)].id.end());
    ids.erase(0);
    found[static_cast<std::size_t>(f)] = std::ssize(ids);
  });
  std::int64_t total = std::ssize(clicks);
  for (const std::int64_t n : found) total += n;
  return total;
}

SegmentSet segments_of_scene(const LoadedScene& scene) {
  SegmentSet set;
  set.from = "instances of the scene";
  set.frames.resize(scene.frames.size());
  for (const int f : scene.frames_of(Split::train)) {
    const StoredFrame& frame = scene.frames[static_cast<std::size_t>(f)];
    if (frame.instance.empty()) continue;
    FrameSegments& to = set.frames[static_cast<std::size_t>(f)];
    to.width_px = frame.width_px;
    to.height_px = frame.height_px;
    to.id = frame.instance;
    if (frame.label.empty()) continue;
    std::map<std::int32_t, std::map<std::int16_t, std::int64_t>> votes;
    for (std::size_t i = 0; i < to.id.size(); ++i)
      if (to.id[i] != 0 && frame.label[i] != kVoid) ++votes[to.id[i]][frame.label[i]];
    for (const auto& [id, of_class] : votes)
      to.class_of[id] = std::max_element(of_class.begin(), of_class.end(), [](const auto& a, const auto& b) {
                          return a.second < b.second;
                        })->first;
    set.classes = set.classes || !to.class_of.empty();
  }
  if (std::all_of(set.frames.begin(), set.frames.end(), [](const FrameSegments& f) { return f.empty(); }))
    throw Error(ErrorKind::data, "objects.segments.none", "no training frame of the scene has instances",
                "name segments of its images with --segments PATH");
  return set;
}

namespace {

using SegmentJson = nlohmann::json;

constexpr std::uint16_t kNoSegment16 = 65535;

/// Segments of an image from its masks, which may overlap: the smaller lies in front of the larger.
FrameSegments painted_segments(std::vector<MaskPixels> masks, std::int32_t width, std::int32_t height) {
  sort_by_area(masks);
  FrameSegments out{
      width, height, std::vector<std::int32_t>(static_cast<std::size_t>(std::int64_t{width} * height), 0), {}};
  std::int32_t id = 0;
  for (const MaskPixels& mask : masks) {
    ++id;
    if (mask.index != kVoid) out.class_of[id] = mask.index;
    for (const PixelRun& run : mask.runs)
      std::fill_n(out.id.begin() + std::int64_t{run.y} * width + run.x0, run.x1 - run.x0, id);
  }
  return out;
}

/// Throws Error(data) beginning with `place` for a size over limits.*, or of another shape than the frame's image.
void check_segment_size(std::int64_t width, std::int64_t height, const FrameInfo& frame, const std::string& place) {
  at_place(place, [&] {
    if (width <= 0 || height <= 0)
      throw Error(ErrorKind::data, "labels.image.size",
                  "an image of " + std::to_string(width) + " x " + std::to_string(height));
    check_image_limits(width, height);
    check_label_shape(width, height, frame.camera);
  });
}

constexpr std::int64_t kMostMasks = 10'000;  // of an image; segmenters find some hundreds
constexpr const char *kMasks = "masks", *kClassIds = "class_ids", *kScores = "scores";

using Shape = std::span<const std::int64_t>;

[[noreturn]] void refuse_shape(Shape shape, const std::string& remedy) {
  throw Error(ErrorKind::data, "labels.array.shape", "the shape is " + shape_text(shape), remedy);
}

std::vector<PixelRun> runs_of_pixels(std::span<const std::uint8_t> inside, std::int32_t width) {
  std::vector<PixelRun> runs;
  for (std::size_t row = 0; row * static_cast<std::size_t>(width) < inside.size(); ++row) {
    const std::span<const std::uint8_t> of_row = inside.subspan(row * static_cast<std::size_t>(width)).first(width);
    for (std::int32_t x = 0; x < width; ++x) {
      if (of_row[static_cast<std::size_t>(x)] == 0) continue;
      const std::int32_t begin = x;
      while (x < width && of_row[static_cast<std::size_t>(x)] != 0) ++x;
      runs.push_back({static_cast<std::int32_t>(row), begin, x});
    }
  }
  return runs;
}

/// Segments of a .npz archive: an array `masks` [N, H, W] ([N, 1, H, W] too), or, without it, one array [H, W] per mask
/// in the order of the archive; of bool or uint8, where other than 0 is inside. `class_ids` [N], ids of the class
/// table, gives segments their class; `scores` is not read, and nothing else beside `masks`. Throws Error(data) naming
/// file and array: what NpzFile refuses, another type or shape, no masks, an image of another shape, and an id that is
/// of no class.
class ArrayMasks {
 public:
  ArrayMasks(const std::string& path, const FrameInfo& frame) : path_(path), frame_(frame), file_(path) {}

  FrameSegments read(const ClassTable& classes) {
    const std::vector<std::string>& keys = file_.keys();
    if (has(kMasks)) {
      add(kMasks, 3, "save an array [masks, height, width]");
    } else {
      for (const std::string& key : keys)
        if (key != kClassIds && key != kScores)
          add(key, 2, "save an array [height, width] per mask, or all as 'masks'");
    }
    if (height_ == 0)
      refuse_labels("labels.array.shape", path_, "holds no masks",
                    "save an array 'masks' [masks, height, width], or an array [height, width] per mask");
    if (has(kClassIds)) read_classes(classes);
    return painted_segments(std::move(masks_), width_, height_);
  }

 private:
  bool has(const char* key) const {
    return std::find(file_.keys().begin(), file_.keys().end(), key) != file_.keys().end();
  }

  // The masks of an array of `axes` axes.
  void add(const std::string& key, std::size_t axes, const char* remedy) {
    const NumpyNumbers<std::uint8_t> array = file_.bytes(key, [&](Shape shape) {
      const bool has_channel = axes == 3 && shape.size() == 4 && shape[1] == 1;
      if (shape.size() != axes && !has_channel) refuse_shape(shape, remedy);
      const std::int64_t height = shape[shape.size() - 2], width = shape.back();
      check_segment_size(width, height, frame_, "masks");
      const std::int64_t masks = std::ssize(masks_) + (axes == 3 ? shape[0] : 1);
      if (masks > kMostMasks) refuse_shape(shape, "save at most " + std::to_string(kMostMasks) + " masks of an image");
      if (height_ != 0 && (height != height_ || width != width_))
        refuse_shape(shape, "save all masks of an image at the size of the first, " +
                                shape_text(std::vector{std::int64_t{height_}, std::int64_t{width_}}));
      height_ = static_cast<std::int32_t>(height);
      width_ = static_cast<std::int32_t>(width);
    });
    const std::size_t pixels = static_cast<std::size_t>(height_) * static_cast<std::size_t>(width_);
    for (std::size_t at = 0; at < array.values.size(); at += pixels) {
      masks_.emplace_back(runs_of_pixels(std::span(array.values).subspan(at, pixels), width_), kVoid);
    }
  }

  void read_classes(const ClassTable& classes) {
    const NumpyNumbers<std::int64_t> ids = file_.whole(kClassIds, [&](Shape shape) {
      if (shape.size() != 1 || shape[0] != std::ssize(masks_))
        refuse_shape(shape, "save one id per mask, " + shape_text(std::vector{std::ssize(masks_)}));
    });
    for (std::size_t k = 0; k < masks_.size(); ++k) {
      const std::int64_t id = ids.values[k];
      const int index = id < 0 || id > 65535 ? -2 : classes.index_of(static_cast<std::int32_t>(id));
      if (index == -2)
        refuse_labels("labels.id.unknown", "'" + path_ + "', entry '" + kClassIds + "'",
                      "mask " + std::to_string(k + 1) + ": " + std::to_string(id) + " is the id of no class",
                      "save ids of the run's classes.yaml, or leave 'class_ids' out");
      masks_[k].index = static_cast<std::int16_t>(index);
    }
  }

  const std::string& path_;
  const FrameInfo& frame_;
  NpzFile file_;
  std::int32_t width_ = 0, height_ = 0;
  std::vector<MaskPixels> masks_;
};

const SegmentJson& member(const SegmentJson& item, const char* key, const std::string& place) {
  if (!item.is_object() || !item.contains(key))
    refuse_labels("labels.file.format", place, std::string("has no '") + key + "'", "write the segments again");
  return item.at(key);
}

// As those of every file of masks, and where the key is not there, with the remedy of segments.
std::int64_t whole_of(const SegmentJson& item, const char* key, const std::string& place) {
  (void)member(item, key, place);
  return semfield::whole_of<SegmentJson>(item, key, place);
}
std::string text_of(const SegmentJson& item, const char* key, const std::string& place) {
  (void)member(item, key, place);
  return semfield::text_of<SegmentJson>(item, key, place);
}

MaskPixels mask_of(const SegmentJson& item, std::int32_t width, std::int32_t height, std::int16_t class_index,
                   const std::string& place) {
  return {coco_mask(member(item, "segmentation", place), width, height, place).runs(width, height, place), class_index};
}

FrameSegments segments_of_ids(const std::string& path, const FrameInfo& frame) {
  const Image<std::uint16_t> image = read_ids(path);
  check_segment_size(image.width_px, image.height_px, frame, path);
  FrameSegments out{image.width_px, image.height_px, {}, {}};
  for (const std::uint16_t id : image.pixels) out.id.push_back(id == kNoSegment16 ? 0 : id);
  return out;
}

// Masks of a segmenter of everything.
FrameSegments segments_of_masks(const std::string& path, const FrameInfo& frame) {
  const SegmentJson root = read_label_json<SegmentJson>(path, "write the segments again");
  const SegmentJson& list = root.is_array() ? root : member(root, "annotations", path);
  if (!list.is_array()) refuse_labels("labels.file.format", path, "'annotations' is not a list");
  std::int64_t width = frame.camera.width_px, height = frame.camera.height_px;
  for (const SegmentJson& item : list) {
    const auto found = item.is_object() ? item.find("segmentation") : item.end();
    if (!item.is_object() || found == item.end() || !found->is_object()) continue;
    const SegmentJson& size = member(*found, "size", path);
    if (!size.is_array() || size.size() != 2 || !size[0].is_number_integer() || !size[1].is_number_integer())
      refuse_labels("labels.run_lengths.damaged", path, "'size' is not a pair of whole numbers");
    height = size[0].get<std::int64_t>();
    width = size[1].get<std::int64_t>();
    break;
  }
  check_segment_size(width, height, frame, path);
  std::vector<MaskPixels> masks;
  std::size_t number = 0;
  for (const SegmentJson& item : list) {
    const std::string place = path + ": mask " + std::to_string(++number);
    masks.push_back(mask_of(item, static_cast<std::int32_t>(width), static_cast<std::int32_t>(height), kVoid, place));
  }
  return painted_segments(std::move(masks), static_cast<std::int32_t>(width), static_cast<std::int32_t>(height));
}

// Classes of COCO's categories, by id.
std::map<std::int64_t, std::int16_t> classes_of_categories(const SegmentJson& root, const ClassTable& classes,
                                                           const std::string& path) {
  std::map<std::int64_t, std::int16_t> out;
  if (!root.contains("categories")) return out;
  const ClassNames names(classes);
  std::size_t number = 0;
  for (const SegmentJson& item : root["categories"]) {
    const std::string place = path + ": category " + std::to_string(++number);
    const int index = names.find(text_of(item, "name", place));
    if (index >= 0) out[whole_of(item, "id", place)] = static_cast<std::int16_t>(index);
  }
  return out;
}

std::int16_t class_of(const SegmentJson& item, const std::map<std::int64_t, std::int16_t>& classes) {
  if (!item.contains("category_id") || !item["category_id"].is_number_integer()) return kVoid;
  const auto found = classes.find(item["category_id"].get<std::int64_t>());
  return found == classes.end() ? kVoid : found->second;
}

FrameSegments segments_of_colors(const std::string& path, const SegmentJson& annotation, const FrameInfo& frame,
                                 const std::map<std::int64_t, std::int16_t>& classes, const std::string& place) {
  const Image<std::uint8_t> image = read_rgb(path);
  check_segment_size(image.width_px, image.height_px, frame, path);
  FrameSegments out{image.width_px, image.height_px, {}, {}};
  for (std::size_t i = 0; i < image.pixels.size(); i += 3)
    out.id.push_back(image.pixels[i] + 256 * image.pixels[i + 1] + 65536 * image.pixels[i + 2]);
  for (const SegmentJson& segment : member(annotation, "segments_info", place)) {
    const std::int64_t id = whole_of(segment, "id", place);
    if (id < 0 || id >= 1 << 24)
      refuse_labels("labels.file.format", place, "segment " + std::to_string(id) + " is not a colour of an image",
                    "write ids from 0 to 16777215: R + 256 G + 65536 B");
    if (const std::int16_t index = class_of(segment, classes); index != kVoid)
      out.class_of[static_cast<std::int32_t>(id)] = index;
  }
  return out;
}

class Reading {
 public:
  Reading(const SceneInfo& info, const std::string& path) : info_(info) {
    set_.from = path;
    set_.frames.resize(info.frames.size());
  }

  void folder(const std::string& path, const std::string& given) {
    for (const char* ending : {".png", ".json", ".npz"}) {
      for (const std::string& pattern :
           given.empty() ? std::vector<std::string>{"{name}", "{stem}"} : std::vector{given}) {
        const std::string named = given.empty() ? pattern + ending : pattern;
        Diagnostics found;
        const std::map<std::string, std::string> files = match_files(path, named, info_.frames, found);
        found.throw_if_errors(ErrorKind::data, "the segments have problems:");
        for (std::size_t f = 0; f < info_.frames.size(); ++f) {
          if (!set_.frames[f].empty() || info_.frames[f].split != Split::train || !files.contains(info_.frames[f].name))
            continue;
          const FrameInfo frame = as_shown(info_.frames[f]);
          const std::string& file = files.at(frame.name);
          set_.frames[f] = file.ends_with(".json")  ? segments_of_masks(file, frame)
                           : file.ends_with(".npz") ? ArrayMasks(file, frame).read(info_.classes)
                                                    : segments_of_ids(file, frame);
        }
      }
    }
  }

  void file(const std::string& path) {
    const SegmentJson root = read_label_json<SegmentJson>(path, "write the segments again");
    const SegmentJson& list = member(root, "annotations", path);
    if (!list.is_array()) refuse_labels("labels.file.format", path, "'annotations' is not a list");
    const std::map<std::int64_t, std::int16_t> classes = classes_of_categories(root, info_.classes, path);
    const bool panoptic = !list.empty() && list[0].is_object() && list[0].contains("segments_info");
    if (panoptic) {
      of_panoptic(path, list, classes);
    } else {
      of_instances(path, root, list, classes);
    }
  }

  SegmentSet finish() {
    // Segments are drawn over images as viewers show them.
    for (std::size_t f = 0; f < set_.frames.size(); ++f) {
      FrameSegments& of = set_.frames[f];
      const int orientation = info_.frames[f].orientation;
      if (turned_by_quarter(orientation)) std::swap(of.width_px, of.height_px);
      of.id = as_stored(std::move(of.id), of.width_px, of.height_px, orientation);
    }
    for (const FrameSegments& frame : set_.frames) set_.classes = set_.classes || !frame.class_of.empty();
    if (std::all_of(set_.frames.begin(), set_.frames.end(), [](const FrameSegments& f) { return f.empty(); })) {
      throw Error(ErrorKind::data, "objects.segments.none",
                  set_.from + ": holds no segments of a training frame, such as '" + info_.frames.front().name + "'",
                  "name files by their frames, or say how they are named with --pattern");
    }
    return std::move(set_);
  }

 private:
  // For each name of a picture the training frame that it is of, as viewers show it; an index below 0: none.
  std::vector<int> frames_of(const std::vector<PictureName>& pictures) const {
    Diagnostics found;
    std::vector<int> out(pictures.size(), -1);
    const std::map<std::string, std::size_t> picture_of = match_frames(pictures, info_.frames, set_.from, found);
    found.throw_if_errors(ErrorKind::data, "the segments have problems:");
    for (std::size_t f = 0; f < info_.frames.size(); ++f) {
      const auto picture = picture_of.find(info_.frames[f].name);
      if (picture != picture_of.end() && info_.frames[f].split == Split::train)
        out[picture->second] = static_cast<int>(f);
    }
    return out;
  }

  void of_panoptic(const std::string& path, const SegmentJson& list,
                   const std::map<std::int64_t, std::int16_t>& classes) {
    const fs::path inside = fs::path(path).replace_extension();
    const fs::path folder = is_folder(inside) ? inside : fs::path(path).parent_path();
    std::vector<PictureName> pictures;
    for (const SegmentJson& item : list) {
      const std::string place = path + ": annotation " + std::to_string(pictures.size() + 1);
      pictures.push_back({.path = text_of(item, "file_name", place), .place = place});
    }
    const std::vector<int> frames = frames_of(pictures);
    for (std::size_t i = 0; i < frames.size(); ++i) {
      if (frames[i] < 0) continue;
      const auto f = static_cast<std::size_t>(frames[i]);
      set_.frames[f] = segments_of_colors((folder / pictures[i].path).string(), list[i], as_shown(info_.frames[f]),
                                          classes, pictures[i].place);
    }
  }

  void of_instances(const std::string& path, const SegmentJson& root, const SegmentJson& list,
                    const std::map<std::int64_t, std::int16_t>& classes) {
    struct OfImage {
      std::int32_t width = 0, height = 0;
      FrameSegments* to = nullptr;
      std::vector<MaskPixels> masks;
    };
    std::map<std::int64_t, OfImage> images;
    std::vector<PictureName> pictures;
    for (const SegmentJson& item : member(root, "images", path)) {
      const std::string place = path + ": image " + std::to_string(pictures.size() + 1);
      pictures.push_back({.path = text_of(item, "file_name", place), .place = place});
    }
    const std::vector<int> frames = frames_of(pictures);
    std::size_t number = 0;
    for (const SegmentJson& item : member(root, "images", path)) {
      const std::string& place = pictures[number].place;
      OfImage image;
      if (const int f = frames[number++]; f >= 0) {
        image.to = &set_.frames[static_cast<std::size_t>(f)];
        const std::int64_t width = whole_of(item, "width", place), height = whole_of(item, "height", place);
        check_segment_size(width, height, as_shown(info_.frames[static_cast<std::size_t>(f)]), place);
        image.width = static_cast<std::int32_t>(width);
        image.height = static_cast<std::int32_t>(height);
      }
      images[whole_of(item, "id", place)] = std::move(image);
    }
    number = 0;
    for (const SegmentJson& item : list) {
      const std::string place = path + ": annotation " + std::to_string(++number);
      const auto image = images.find(whole_of(item, "image_id", place));
      if (image == images.end())
        refuse_labels("labels.annotation.reference", place,
                      "no image has the id " + member(item, "image_id", place).dump());
      if (image->second.to == nullptr) continue;
      image->second.masks.push_back(
          mask_of(item, image->second.width, image->second.height, class_of(item, classes), place));
    }
    for (auto& [id, image] : images)
      if (image.to != nullptr && !image.masks.empty())
        *image.to = painted_segments(std::move(image.masks), image.width, image.height);
  }

  const SceneInfo& info_;
  SegmentSet set_;
};

}  // namespace

SegmentSet read_segments(const std::string& path, const std::string& pattern, const SceneInfo& info) {
  Reading reading(info, path);
  if (is_folder(path)) {
    if (!pattern.empty()) {
      Diagnostics found;
      check_pattern(pattern, found);
      found.throw_if_errors(ErrorKind::usage, "--pattern:");
    }
    reading.folder(path, pattern);
  } else if (is_there(path)) {
    reading.file(path);
  } else {
    throw Error(ErrorKind::no_input, "files.read.missing", "no file or folder '" + path + "'",
                "name segments of the training images with --segments");
  }
  return reading.finish();
}

}  // namespace semfield
