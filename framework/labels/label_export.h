// Label maps as files that labelling tools open: COCO and labelme.
#pragma once

#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "scene/classes/class_table.h"

namespace semfield {

/// A frame's label map, of the picture as viewers show it.
struct LabelledFrame {
  std::string name;
  std::string image_path;  ///< of the colour image, or "" where the frame has no file
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::int16_t> label;  ///< [H * W] internal class index, kVoid = void
  std::string picture = {};         ///< what a COCO file calls the image (labels/frame_match.h: picture_names); or ""
};

/// How COCO annotations say their pixels: one polygon a connected region, or one run-length text a class.
enum class CocoMasks { polygons, run_lengths };

/// Frames of one COCO file [Lin14]; categories are the classes with a name that are not ignored, under their own ids.
/// Labels name no others (class_table.h: is_unnamed_class). Polygons run along pixel edges, a hole being joined by a
/// cut without width, so they give the same pixels back. Run lengths are marked iscrowd, as COCO wants it. An image is
/// called as LabelledFrame::picture says; else as its file, or as its frame where it has none or where another image
/// was called so before.
class CocoExport {
 public:
  CocoExport(ClassTable classes, CocoMasks masks) : classes_(std::move(classes)), masks_(masks) {}
  void add(const LabelledFrame& frame);
  std::int64_t annotations() const { return annotation_count_; }
  /// Throws Error(io).
  void write(const std::string& path) const;

 private:
  std::string image_name(const LabelledFrame& frame);
  void annotate(const std::string& text);
  ClassTable classes_;
  CocoMasks masks_;
  std::string images_, annotations_;
  std::set<std::string> stems_;  // of the images so far
  std::int64_t image_count_ = 0, annotation_count_ = 0;
};

/// FRAME.json in `folder`: one polygon a connected region, as for COCO. Slashes of the name become '_'. Returns the
/// number of shapes; throws Error(io).
std::int64_t write_labelme(const std::string& folder, const LabelledFrame& frame, const ClassTable& classes);

}  // namespace semfield
