// Segments of the images of a scene: which pixels of an image are one thing. Their numbers mean nothing in another
// image.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "labels/clicks.h"
#include "scene/loading/frame_source.h"

namespace semfield {

/// Of one image, at any size of its shape.
struct FrameSegments {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::int32_t> id;                   ///< [H * W] 0: no segment is known there
  std::map<std::int32_t, std::int16_t> class_of;  ///< class indices of those segments whose class is known

  bool empty() const { return id.empty(); }
  /// The segment at a pixel of the frame, which may have another size.
  std::int32_t at(std::int32_t column, std::int32_t row, std::int32_t frame_width, std::int32_t frame_height) const;
};

/// An entry per frame of SceneInfo, empty where an image has none. Or a person's clicks, which name things of the scene
/// and not pixels of an image.
struct SegmentSet {
  std::vector<FrameSegments> frames;
  std::vector<Annotations::Mark> clicks;  ///< class indices of SceneInfo; with them all frames are empty
  std::string from;                       ///< in words: "instances of the scene", "masks.json"
  bool classes = false;                   ///< any segment has a class

  std::int64_t count() const;  ///< segments of all images, or clicks
};

/// The scene's own instances as segments of its training frames; the class of one is that of most of its labelled
/// pixels. Throws Error(data) where none of these frames has instances.
SegmentSet segments_of_scene(const LoadedScene& scene);

// Segments from files that other programs write.

/// `path` is one of:
///   a folder of PNGs, one per frame by `pattern` (check_pattern): ids of 8 or 16 bits, or indices of a palette; 0, and
///     65535 of 16 bits, is no segment. Instance images of Replica and ScanNet are such.
///   a folder of JSON files, one per frame by `pattern`: masks of a segmenter of everything, a list of {segmentation},
///     or an object with such a list as `annotations`; segmentation as run lengths {size, counts} or as polygons.
///   a folder of .npz files, one per frame by `pattern`: `masks` [N, H, W] or an array [H, W] per mask, of bool or
///     uint8, and `class_ids` [N] of the class table.
///   a JSON file of COCO's panoptic form: `annotations` of {file_name, segments_info}, PNGs in the folder of its name
///     without .json, or beside it, whose pixels are R + 256 G + 65536 B [Kirillov19].
///   a JSON file of COCO's instances: `images`, and `annotations` of {image_id, segmentation} [Lin14].
/// Frames are found by match_frames() and match_files(), and segments are of images as viewers show them. Of masks that
/// overlap the smaller lies in front. Names of categories that the scene's table has give segments their class; others
/// have none. `pattern` "": "{name}" with the ending of the files, and "{stem}". Throws Error(data) naming file and
/// entry; Error(no_input) for what is not there; Error(data) where no training frame has segments.
SegmentSet read_segments(const std::string& path, const std::string& pattern, const SceneInfo& info);

}  // namespace semfield
