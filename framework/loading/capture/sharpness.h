// How sharp pictures are, and which frames of a film are worth a pose.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

namespace semfield {

/// Variance of the Laplacian over that of the picture [Pertuz13]: a blurred copy of the same picture has less. Grey
/// values, row by row, `width` of them; 0 of an even picture.
double sharpness(std::span<const std::uint8_t> grey, std::int32_t width);
/// Of a photograph, at 1,024 pixels of its longer side. Throws as read_rgb does.
double sharpness_of(const std::string& photograph);
/// Below this share of the median, a picture is called blurred.
inline constexpr double kBlurredShare = 0.3;
double median_of(std::vector<double> values);

/// Frames of a film that are kept, and why others were not.
struct FrameChoice {
  std::vector<std::size_t> kept;  ///< ascending
  std::size_t still = 0;          ///< intervals whose sharpest frame shows what the kept one before it shows
  std::size_t blurred = 0;        ///< intervals whose sharpest frame is blurred
};
/// Of `frames`, small grey pictures of `pixels` values each, the sharpest of each of `intervals` intervals of one
/// length. A frame is still where it differs from the last one kept by less than two grey levels in the mean, and
/// blurred below kBlurredShare of the median of the sharpest.
FrameChoice choose_frames(std::span<const std::uint8_t> frames, std::size_t pixels, std::int32_t width,
                          std::size_t intervals);

}  // namespace semfield
