// Segments from files that other programs write.
#pragma once

#include <string>

#include "objects/segments.h"

namespace semfield {

/// `path` is one of:
///   a folder of PNGs, one per frame by `pattern` (check_pattern): ids of 8 or 16 bits, or indices of a palette; 0, and
///     65535 of 16 bits, is no segment. Instance images of Replica and ScanNet are such.
///   a folder of JSON files, one per frame by `pattern`: masks of a segmenter of everything, a list of {segmentation},
///     or an object with such a list as `annotations`; segmentation as run lengths {size, counts} or as polygons.
///   a folder of .npz files, one per frame by `pattern`: segments_of_arrays.
///   a JSON file of COCO's panoptic form: `annotations` of {file_name, segments_info}, PNGs in the folder of its name
///     without .json, or beside it, whose pixels are R + 256 G + 65536 B [Kirillov19].
///   a JSON file of COCO's instances: `images`, and `annotations` of {image_id, segmentation} [Lin14].
/// Frames are found by match_frames() and match_files(), and segments are of images as viewers show them. Of masks that
/// overlap the smaller lies in front. Names of categories that the scene's table has give segments their class; others
/// have none. `pattern` "": "{name}" with the ending of the files, and "{stem}". Throws Error(data) naming file and
/// entry; Error(no_input) for what is not there; Error(data) where no training frame has segments.
SegmentSet read_segments(const std::string& path, const std::string& pattern, const SceneInfo& info);

}  // namespace semfield
