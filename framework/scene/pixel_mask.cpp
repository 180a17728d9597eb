// Masks as bits.
#include "scene/pixel_mask.h"

#include <algorithm>

#include "scene/scene.h"

namespace semfield {

PixelMask::PixelMask(std::span<const std::uint8_t> used) {
  masked_px_ = std::count(used.begin(), used.end(), std::uint8_t{0});
  if (masked_px_ == 0) return;
  pixels_ = used.size();
  words_.resize((pixels_ + 63) / 64);
  for (std::size_t i = 0; i < pixels_; ++i) words_[i / 64] |= std::uint64_t{used[i] != 0 ? 1U : 0U} << (i % 64);
}

std::vector<std::uint8_t> PixelMask::expand() const {
  std::vector<std::uint8_t> out(pixels_);
  for (std::size_t i = 0; i < pixels_; ++i) out[i] = uses(i) ? 1 : 0;
  return out;
}

void hide_masked(FrameBuffer& frame) {
  for (std::size_t i = 0; i < frame.used.size(); ++i) {
    if (frame.used[i] != 0) continue;
    std::fill_n(frame.rgb.begin() + static_cast<std::ptrdiff_t>(3 * i), 3, std::uint8_t{0});
    if (!frame.depth_m.empty()) frame.depth_m[i] = 0;
    if (!frame.label.empty()) frame.label[i] = kVoid;
    if (!frame.instance.empty()) frame.instance[i] = 0;
  }
}

}  // namespace semfield
