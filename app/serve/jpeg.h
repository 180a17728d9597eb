// JPEG pictures for the page, by TurboJPEG.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace semfield::app {

/// `rgb`: [height * width * 3]. Throws Error(internal) where TurboJPEG refuses.
std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality = 85);

}  // namespace semfield::app
