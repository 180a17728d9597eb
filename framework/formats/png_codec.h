// PNG in and out through zlib alone: palette indices and 16-bit values stay as they are, and damage is named.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "formats/image_io.h"
#include "formats/text_rows.h"

namespace semfield {

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

}  // namespace semfield
