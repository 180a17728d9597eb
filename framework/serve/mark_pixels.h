// Which pixels of a view a click or a stroke names.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "eval/pixel_stride.h"
#include "labels/clicks/annotations.h"

namespace semfield {

/// Pixels of a view of this size that the mark paints (runs_of); the first point's own comes first, or one in the
/// middle of an outline. With `painted`
/// [height * width], those alone that still have the mark's class.
std::vector<PixelPlace> pixels_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px,
                                  std::span<const std::int16_t> painted = {});

}  // namespace semfield
