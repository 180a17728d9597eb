#include "objects/segment_masks.h"

#include <algorithm>
#include <span>

#include "formats/input_limits.h"
#include "formats/npz.h"
#include "labels/label_files.h"

namespace semfield {

namespace {

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
      SegmentMask mask;
      mask.runs = runs_of_pixels(std::span(array.values).subspan(at, pixels), width_);
      mask.area = area_of(mask.runs);
      masks_.push_back(std::move(mask));
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
      masks_[k].class_index = static_cast<std::int16_t>(index);
    }
  }

  const std::string& path_;
  const FrameInfo& frame_;
  NpzFile file_;
  std::int32_t width_ = 0, height_ = 0;
  std::vector<SegmentMask> masks_;
};

}  // namespace

FrameSegments painted_segments(std::vector<SegmentMask> masks, std::int32_t width, std::int32_t height) {
  std::stable_sort(masks.begin(), masks.end(),
                   [](const SegmentMask& a, const SegmentMask& b) { return a.area > b.area; });
  FrameSegments out{
      width, height, std::vector<std::int32_t>(static_cast<std::size_t>(std::int64_t{width} * height), 0), {}};
  std::int32_t id = 0;
  for (const SegmentMask& mask : masks) {
    ++id;
    if (mask.class_index != kVoid) out.class_of[id] = mask.class_index;
    for (const PixelRun& run : mask.runs)
      std::fill_n(out.id.begin() + std::int64_t{run.y} * width + run.x0, run.x1 - run.x0, id);
  }
  return out;
}

void check_segment_size(std::int64_t width, std::int64_t height, const FrameInfo& frame, const std::string& place) {
  try {
    if (width <= 0 || height <= 0)
      throw Error(ErrorKind::data, "labels.image.size",
                  "an image of " + std::to_string(width) + " x " + std::to_string(height));
    check_image_limits(width, height);
    check_label_shape(width, height, frame.camera);
  } catch (const Error& e) {
    refuse_labels(e.code(), place, e.message(), e.remedy());
  }
}

FrameSegments segments_of_arrays(const std::string& path, const FrameInfo& frame, const ClassTable& classes) {
  return ArrayMasks(path, frame).read(classes);
}

}  // namespace semfield
