// JSON of label files: members by their kind, and COCO's masks [Lin14]. `Json` is a type of nlohmann-json, which no
// header names.
#pragma once

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "core/files.h"
#include "core/text.h"
#include "labels/label_files.h"
#include "labels/mask_outlines.h"

namespace semfield {

// Each throws Error(data) that begins with `place`, or names the file.

/// f(), whose errors name the place then.
template <class F>
auto at_place(const std::string& place, const F& f) {
  try {
    return f();
  } catch (const Error& e) {
    refuse_labels(e.code(), place, e.message(), e.remedy());
  }
}

template <class Json>
Json read_label_json(const std::string& path, const std::string& remedy) {
  try {
    return Json::parse(read_text_file(path));
  } catch (const typename Json::exception& e) {
    refuse_labels("labels.file.format", path, "not valid JSON: " + json_cause(e.what()), remedy);
  }
}

template <class Json>
std::int64_t whole_of(const Json& item, const char* key, const std::string& place) {
  const auto found = item.find(key);
  if (found == item.end() || !found->is_number_integer())
    refuse_labels("labels.file.format", place, std::string("needs a whole number '") + key + "'");
  return found->template get<std::int64_t>();
}

/// Of at least so many bytes.
template <class Json>
std::string text_of(const Json& item, const char* key, const std::string& place, std::size_t least = 0) {
  const auto found = item.find(key);
  if (found == item.end() || !found->is_string() || found->template get<std::string>().size() < least)
    refuse_labels("labels.file.format", place, std::string("needs a text '") + key + "'");
  return found->template get<std::string>();
}

/// Near the image: at most kMaxCoordinate from 0. `which` stands in the message: "point 3".
inline PixelPoint point_near_image(double x, double y, const std::string& which, const std::string& place) {
  if (!(std::abs(x) <= kMaxCoordinate) || !(std::abs(y) <= kMaxCoordinate))
    refuse_labels("labels.shape.outside", place, which + " lies more than a million pixels outside");
  return {x, y};
}

/// Polygons, or run lengths, or neither: no pixels.
struct CocoMask {
  std::vector<Outline> parts;
  std::vector<std::int64_t> counts;  ///< empty with parts

  std::vector<PixelRun> runs(std::int32_t width, std::int32_t height, const std::string& place) const {
    if (!counts.empty()) return at_place(place, [&] { return runs_of_counts(counts, width, height); });
    std::vector<PixelRun> out;
    for (const Outline& part : parts) {
      const std::vector<PixelRun> of_part = outline_runs(part, width, height);
      out.insert(out.end(), of_part.begin(), of_part.end());
    }
    return out;
  }
};

template <class Json>
Outline coco_outline(const Json& part, const std::string& place) {
  if (!part.is_array() || part.size() < 6 || part.size() % 2 != 0 || part.size() > 2 * kMaxOutlinePoints)
    refuse_labels("labels.shape.points", place,
                  "a polygon is a list [x, y, x, y, ...] of 3 to " + std::to_string(kMaxOutlinePoints) + " points");
  Outline outline;
  for (std::size_t i = 0; i < part.size(); i += 2) {
    const std::string which = "point " + std::to_string(i / 2 + 1);
    if (!part[i].is_number() || !part[i + 1].is_number())
      refuse_labels("labels.file.format", place, which + " is not a pair of numbers");
    outline.push_back(
        point_near_image(part[i].template get<double>(), part[i + 1].template get<double>(), which, place));
  }
  return outline;
}

template <class Json>
std::vector<std::int64_t> coco_counts(const Json& segmentation, std::int32_t width, std::int32_t height,
                                      const std::string& place) {
  const auto size = segmentation.find("size");
  if (size != segmentation.end() && *size != Json::array({height, width}))
    refuse_labels("labels.image.size", place,
                  "run lengths of size " + size->dump() + ", the image is [" + std::to_string(height) + "," +
                      std::to_string(width) + "] (height, width)");
  const auto counts = segmentation.find("counts");
  if (counts == segmentation.end() || (!counts->is_string() && !counts->is_array()))
    refuse_labels("labels.run_lengths.damaged", place, "run lengths need 'counts', a list or a text");
  std::vector<std::int64_t> out;
  if (counts->is_string()) out = at_place(place, [&] { return counts_of_text(counts->template get<std::string>()); });
  for (std::size_t i = 0; counts->is_array() && i < counts->size(); ++i) {
    if (!(*counts)[i].is_number_integer())
      refuse_labels("labels.run_lengths.damaged", place, "count " + std::to_string(i + 1) + " is not a whole number");
    out.push_back((*counts)[i].template get<std::int64_t>());
  }
  if (out.empty()) refuse_labels("labels.run_lengths.damaged", place, "run lengths without a count");
  return out;
}

/// A 'segmentation' of an image of this size.
template <class Json>
CocoMask coco_mask(const Json& segmentation, std::int32_t width, std::int32_t height, const std::string& place) {
  CocoMask mask;
  if (segmentation.is_object()) {
    mask.counts = coco_counts(segmentation, width, height, place);
  } else if (segmentation.is_array()) {
    for (const Json& part : segmentation) mask.parts.push_back(coco_outline(part, place));
  } else {
    refuse_labels("labels.file.format", place, "'segmentation' is neither polygons nor run lengths");
  }
  return mask;
}

/// The pixels of a mask.
struct MaskPixels {
  std::vector<PixelRun> runs;
  std::int16_t index = kVoid;  ///< class index
  std::int64_t area = 0;

  MaskPixels(std::vector<PixelRun> of, std::int16_t of_class)
      : runs(std::move(of)), index(of_class), area(area_of(runs)) {}
};

/// In the order in which they are painted: what is in front of a large thing is mostly smaller than it.
inline void sort_by_area(std::vector<MaskPixels>& masks) {
  std::stable_sort(masks.begin(), masks.end(),
                   [](const MaskPixels& a, const MaskPixels& b) { return a.area > b.area; });
}

}  // namespace semfield
