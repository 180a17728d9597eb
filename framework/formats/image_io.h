// Images in and out. PNG goes through libpng's lower half, so that palette indices and damage are seen as they are;
// other formats are read by OpenImageIO (ImageFormats). A build without OpenImageIO (SEMFIELD_WITH_IMAGES=OFF) still
// reads and writes PNG, and throws Error(unavailable) for every other format.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "formats/text_rows.h"

namespace semfield {

/// Place of a pixel in row-major values of a picture `width` pixels wide.
constexpr std::size_t pixel_at(std::int64_t x, std::int64_t y, std::int64_t width) {
  return static_cast<std::size_t>(y * width + x);
}

/// Row-major, channels interleaved.
template <class T>
struct Image {
  std::int32_t width_px = 0, height_px = 0, channels = 0;
  std::vector<T> pixels;
  /// The only channel of a pixel.
  T at(std::int32_t x, std::int32_t y) const { return pixels[pixel_at(x, y, width_px)]; }
};

struct ImageSize {
  std::int32_t width_px = 0, height_px = 0, channels = 0;
  int bits = 8;
  int orientation = 1;  ///< EXIF: 1 = as stored; pixels are always read as they are stored
};

/// "640 x 480".
inline std::string size_text(std::int32_t width_px, std::int32_t height_px) {
  return std::to_string(width_px) + " x " + std::to_string(height_px);
}

/// What a photograph's EXIF tells of the camera.
struct CameraTag {
  std::string model;    ///< "Apple iPhone 12"; empty where it is not told
  double focal_mm = 0;  ///< of the lens as it was set; 0 where it is not told
};

bool images_available();
/// Header only. Refuses what is over input_limits() before allocating. Errors name the path and the cause.
ImageSize image_size(const std::string& path);
/// Nothing of a PNG. Throws as image_size.
CameraTag camera_tag(const std::string& path);
/// 8-bit colour, always 3 channels (grey replicated, alpha over `white`/dropped as `alpha_background` says: -1 drop,
/// else 0..255). `alpha`, if it is wanted, gets [H * W], 255 for every pixel of an image without.
Image<std::uint8_t> read_rgb(const std::string& path, int alpha_background = -1,
                             std::vector<std::uint8_t>* alpha = nullptr);
/// Single-channel integer image (labels, depth in mm, instances), 8 or 16 bit, values unchanged; palette PNGs give
/// indices.
Image<std::uint16_t> read_ids(const std::string& path);
/// Single-channel float image (EXR depth).
Image<float> read_float(const std::string& path);

/// Written to a temporary name and renamed. 8-bit RGB, 8-bit or 16-bit grey PNG; palette PNG (index + colours).
void write_png_rgb(const std::string& path, std::int32_t width, std::int32_t height, std::span<const std::uint8_t> rgb);
void write_png_gray16(const std::string& path, std::int32_t width, std::int32_t height,
                      std::span<const std::uint16_t> values);
void write_png_gray8(const std::string& path, std::int32_t width, std::int32_t height,
                     std::span<const std::uint8_t> values);
void write_png_palette(const std::string& path, std::int32_t width, std::int32_t height,
                       std::span<const std::uint8_t> index, std::span<const std::uint8_t> palette_rgb);
/// NumPy .npy, float32, C order.
void write_npy(const std::string& path, std::span<const std::int64_t> shape, std::span<const float> values);

/// For each of `to` pixels the nearest of `from`: the one that holds its centre. For ids and depth, whose averages mean
/// nothing.
std::vector<std::int64_t> nearest_pixels(std::int32_t from, std::int32_t to);
/// Those values of a picture of `from` pixels at the size `to`, one a pixel; of no values none.
template <class T>
std::vector<T> at_nearest_pixels(const std::vector<T>& values, const ImageSize& from, const ImageSize& to) {
  std::vector<T> out;
  if (values.empty()) return out;
  const auto rows = nearest_pixels(from.height_px, to.height_px), cols = nearest_pixels(from.width_px, to.width_px);
  out.reserve(rows.size() * cols.size());
  for (const std::int64_t row : rows)
    for (const std::int64_t col : cols) out.push_back(values[pixel_at(col, row, from.width_px)]);
  return out;
}
/// Area-averaged colour, for downscaling only.
Image<std::uint8_t> resize_area(const Image<std::uint8_t>& image, std::int32_t width, std::int32_t height);

// Pictures as viewers show them: by its EXIF orientation a file's stored pixels are turned or mirrored [Exif 2.3].

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

// PNG in and out: palette indices and 16-bit values stay as they are, and damage is named.

/// Samples as stored: grey, grey + alpha, RGB, RGBA, or palette index.
struct PngImage {
  std::int32_t width_px = 0, height_px = 0, channels = 0;
  int bits = 8;  ///< 1, 2, 4, 8 or 16: the largest sample is 2^bits - 1
  bool palette = false;
  std::vector<std::uint8_t> palette_rgb;    ///< 3 bytes per entry
  std::vector<std::uint8_t> palette_alpha;  ///< may be shorter than the palette: the rest is opaque
  std::vector<std::uint8_t> bytes;          ///< one byte a sample, for images of up to 8 bits
  std::vector<std::uint16_t> words;         ///< the samples of 16-bit images

  unsigned sample(std::size_t i) const { return bits == 16 ? words[i] : bytes[i]; }
};

bool looks_like_png(std::span<const std::byte> bytes);
/// Dimensions from the first chunk. Throws Error(data) as decode_png does.
ImageSize png_size(std::span<const std::byte> bytes);
/// Whole image [PNG3]. Throws Error(data) with the cause (no path: the caller adds it) for a wrong checksum, a missing
/// end, sizes over input_limits(), and data too short for the stated size - the last before the pixels are
/// allocated.
PngImage decode_png(std::span<const std::byte> bytes);

/// Colours of palette indices, 3 bytes each, and how opaque the first of them are (PngImage::palette_alpha).
struct PngPalette {
  std::span<const std::uint8_t> rgb{};
  std::span<const std::uint8_t> alpha{};
};

/// color_type 0 grey, 2 RGB, 3 palette; rows are packed big-endian bytes of width * channels * bits / 8. `level` is
/// zlib's: 1 for pictures that are sent and forgotten.
std::vector<std::uint8_t> encode_png(std::int32_t width, std::int32_t height, int color_type, int bits,
                                     std::span<const std::uint8_t> rows, const PngPalette& palette = {}, int level = 4);

// Images other than PNG, read by OpenImageIO in a library of its own that is loaded when the first such image is met:
// OpenImageIO brings some 250 libraries with it, which cost a quarter of a second and over 100 MB before anything runs.

/// What that library offers; every call throws Error(data) without the path for a file that cannot be read.
struct ImageFormats {
  ImageSize (*size)(const std::string& path);
  CameraTag (*camera)(const std::string& path);
  Image<std::uint8_t> (*read8)(const std::string& path);
  Image<std::uint16_t> (*read16)(const std::string& path);
  Image<float> (*read_float)(const std::string& path);
};

/// The table, loaded once. Throws Error(unavailable) in a build without OpenImageIO, and when the library is missing.
const ImageFormats& image_formats();

/// True once image_formats() has loaded the library.
bool image_formats_loaded();

/// The library's one exported symbol.
inline constexpr const char* kImageFormatsSymbol = "semfield_image_formats";

}  // namespace semfield
