// Speckles of a label map: small connected regions given to what surrounds them.
#pragma once

#include <cstdint>
#include <vector>

namespace semfield {

struct SmallRegions {
  std::int64_t regions = 0, pixels = 0;  ///< that changed class
};

/// Pixels of regions (connected through pixel edges, void too) with fewer than `min_area_px` pixels take the class of
/// the nearest larger region, in steps from pixel to pixel through small regions. Pixels of larger regions keep their
/// class, and no smaller region is left. A map of small regions alone stays as it is.
SmallRegions fill_small_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                                std::int64_t min_area_px);

}  // namespace semfield
