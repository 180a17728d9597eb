// Masks of a segmenter of one image: what they have in common, and masks in NumPy archives.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "labels/outline_fill.h"
#include "objects/segments.h"

namespace semfield {

/// Pixels of one segment.
struct SegmentMask {
  std::vector<PixelRun> runs;
  std::int64_t area = 0;  ///< pixels
  std::int16_t class_index = kVoid;
};

/// Segments of an image from its masks, which may overlap: the smaller lies in front of the larger.
FrameSegments painted_segments(std::vector<SegmentMask> masks, std::int32_t width, std::int32_t height);

/// Throws Error(data) beginning with `place` for a size over limits.*, or of another shape than the frame's image.
void check_segment_size(std::int64_t width, std::int64_t height, const FrameInfo& frame, const std::string& place);

/// Segments of a .npz archive: an array `masks` [N, H, W] ([N, 1, H, W] too), or, without it, one array [H, W] per mask
/// in the order of the archive; of bool or uint8, where other than 0 is inside. `class_ids` [N], ids of the class
/// table, gives segments their class; `scores` is not read, and nothing else beside `masks`. Throws Error(data) naming
/// file and array: what NpzFile refuses, another type or shape, no masks, an image of another shape, and an id that is
/// of no class.
FrameSegments segments_of_arrays(const std::string& path, const FrameInfo& frame, const ClassTable& classes);

}  // namespace semfield
