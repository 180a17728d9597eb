// Connected regions of a label map as closed outlines that give the same pixels back.
#pragma once

#include <cstdint>
#include <vector>

#include "labels/outline_fill.h"

namespace semfield {

/// A region of one class, connected through pixel edges.
struct MaskRegion {
  std::int16_t index = 0;  ///< internal class index
  std::int64_t area_px = 0;
  Outline outline;  ///< along pixel edges, clockwise; corners only
};

/// Regions of all classes of `label` [height * width], in the order of their first pixels; void has none. A hole is
/// joined to the rest of the outline by a horizontal cut without width, so one outline says all of a region and
/// outline_runs of it gives exactly its pixels, by the even-odd and by the non-zero rule.
std::vector<MaskRegion> mask_regions(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height);

}  // namespace semfield
