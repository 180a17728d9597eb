// The pixels that a frame is scored at: every s-th of every s-th row.
#pragma once

#include <cstdint>
#include <vector>

namespace semfield {

struct PixelPlace {
  std::int32_t column = 0, row = 0;
};

/// Pixels that a stride takes of a side; the stride is at most its length.
inline std::int32_t strided_px(std::int32_t length_px, std::int32_t stride) { return length_px / stride; }

/// Where pixel `index` of the smaller map, `map_width_px` wide, lies in the frame.
inline PixelPlace strided_place(std::int64_t index, std::int32_t map_width_px, std::int32_t stride) {
  return {static_cast<std::int32_t>(index % map_width_px) * stride + stride / 2,
          static_cast<std::int32_t>(index / map_width_px) * stride + stride / 2};
}

/// The values [height * width * channels] that a stride takes; an empty map stays empty.
template <class Value>
std::vector<Value> strided(std::vector<Value> whole, std::int32_t width_px, std::int32_t height_px,
                           std::int32_t channels, std::int32_t stride) {
  if (stride == 1 || whole.empty()) return whole;
  const std::int32_t width = strided_px(width_px, stride), height = strided_px(height_px, stride);
  std::vector<Value> out;
  out.reserve(static_cast<std::size_t>(std::int64_t{width} * height * channels));
  for (std::int64_t i = 0; i < std::int64_t{width} * height; ++i) {
    const PixelPlace at = strided_place(i, width, stride);
    const auto first = whole.begin() + (std::int64_t{at.row} * width_px + at.column) * channels;
    out.insert(out.end(), first, first + channels);
  }
  return out;
}

}  // namespace semfield
