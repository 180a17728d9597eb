// Which pixels of a frame count: the others draw no rays, teach nothing and are in no score.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace semfield {

struct FrameBuffer;

/// A bit a pixel, in words of 64, the first pixel lowest. Empty: every pixel counts, which costs nothing.
class PixelMask {
 public:
  static constexpr std::int64_t kWordPixels = 64;

  PixelMask() = default;
  /// `used` [H * W], 0 = masked; empty where no pixel is masked.
  explicit PixelMask(std::span<const std::uint8_t> used);

  bool empty() const { return words_.empty(); }
  bool uses(std::size_t pixel) const { return words_.empty() || ((words_[pixel / 64] >> (pixel % 64)) & 1) != 0; }
  /// 0 for an empty mask.
  std::int64_t masked_px() const { return masked_px_; }
  std::span<const std::uint64_t> words() const { return words_; }
  /// [H * W] of 1 and 0; empty for an empty mask.
  std::vector<std::uint8_t> expand() const;
  std::size_t bytes() const { return words_.capacity() * sizeof(std::uint64_t); }
  bool operator==(const PixelMask&) const = default;

 private:
  std::vector<std::uint64_t> words_;
  std::size_t pixels_ = 0;
  std::int64_t masked_px_ = 0;
};

/// Takes colour, depth, label and instance from the masked pixels of FrameBuffer::used, so that nothing can read what
/// lies there: black, no depth, void, none.
void hide_masked(FrameBuffer& frame);

}  // namespace semfield
