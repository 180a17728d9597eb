// Pictures as viewers show them: by its EXIF orientation a file's stored pixels are turned or mirrored [Exif 2.3].
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace semfield {

/// Orientations 5 to 8: width and height change places.
constexpr bool turned_by_quarter(int orientation) { return orientation >= 5 && orientation <= 8; }

struct ShownPlace {
  std::int64_t x = 0, y = 0;
};

/// Where viewers show pixel (x, y) of a picture that is stored as width x height pixels.
constexpr ShownPlace shown_place(std::int64_t x, std::int64_t y, std::int64_t width, std::int64_t height,
                                 int orientation) {
  const bool quarter = turned_by_quarter(orientation);
  const ShownPlace at = quarter ? ShownPlace{y, x} : ShownPlace{x, y};
  const bool flip_x = orientation == 2 || orientation == 3 || orientation == 6 || orientation == 7;
  const bool flip_y = orientation == 3 || orientation == 4 || orientation == 7 || orientation == 8;
  return {flip_x ? (quarter ? height : width) - 1 - at.x : at.x, flip_y ? (quarter ? width : height) - 1 - at.y : at.y};
}

/// For each pixel of a picture stored as width x height, row by row, where it stands in the picture as shown.
inline std::vector<std::size_t> shown_pixels(std::int64_t width, std::int64_t height, int orientation) {
  std::vector<std::size_t> out;
  out.reserve(static_cast<std::size_t>(width * height));
  const std::int64_t across = turned_by_quarter(orientation) ? height : width;
  for (std::int64_t y = 0; y < height; ++y) {
    for (std::int64_t x = 0; x < width; ++x) {
      const ShownPlace at = shown_place(x, y, width, height, orientation);
      out.push_back(static_cast<std::size_t>(at.y * across + at.x));
    }
  }
  return out;
}

/// Values of stored pixels, `cols` each, as viewers show them.
template <class T>
std::vector<T> as_shown(std::vector<T> stored, std::int64_t width, std::int64_t height, int orientation,
                        std::size_t cols = 1) {
  if (orientation <= 1 || stored.empty()) return stored;
  std::vector<T> out(stored.size());
  const std::vector<std::size_t> to = shown_pixels(width, height, orientation);
  for (std::size_t p = 0; p < to.size(); ++p)
    for (std::size_t c = 0; c < cols; ++c) out[to[p] * cols + c] = stored[p * cols + c];
  return out;
}

/// as_shown() read back: `width` and `height` are those of the stored picture.
template <class T>
std::vector<T> as_stored(std::vector<T> shown, std::int64_t width, std::int64_t height, int orientation) {
  if (orientation <= 1 || shown.empty()) return shown;
  std::vector<T> out(shown.size());
  const std::vector<std::size_t> from = shown_pixels(width, height, orientation);
  for (std::size_t p = 0; p < from.size(); ++p) out[p] = shown[from[p]];
  return out;
}

}  // namespace semfield
