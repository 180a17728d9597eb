// Pixels of one frame as a loaded scene keeps them: the narrowest type that holds every value exactly.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "scene/pixel_mask.h"
#include "scene/scene.h"

namespace semfield {

/// Class indices, kVoid = void: a byte a pixel up to index 254, else two.
class LabelMap {
 public:
  LabelMap() = default;
  explicit LabelMap(std::vector<std::int16_t> labels);

  std::size_t size() const { return narrow_.size() + wide_.size(); }
  bool empty() const { return size() == 0; }
  std::int16_t operator[](std::size_t i) const {
    if (narrow_.empty()) return wide_[i];
    return narrow_[i] == kNarrowVoid ? kVoid : static_cast<std::int16_t>(narrow_[i]);
  }
  /// [H * W], as read.
  std::vector<std::int16_t> expand() const;
  std::size_t bytes() const { return narrow_.capacity() + wide_.capacity() * sizeof(std::int16_t); }
  bool operator==(const LabelMap&) const = default;

 private:
  static constexpr std::uint8_t kNarrowVoid = 255;
  std::vector<std::uint8_t> narrow_;  // one of the two is empty
  std::vector<std::int16_t> wide_;
};

/// z-depth in metres, 0 = invalid: two bytes per pixel where every value is a whole number of millimetres, else float.
class DepthMap {
 public:
  DepthMap() = default;
  explicit DepthMap(std::vector<float> depth_m);

  std::size_t size() const { return millimetres_.size() + metres_.size(); }
  bool empty() const { return size() == 0; }
  float operator[](std::size_t i) const { return millimetres_.empty() ? metres_[i] : metres_of(millimetres_[i]); }
  /// [H * W], the same bits as read.
  std::vector<float> expand() const;
  std::size_t bytes() const {
    return millimetres_.capacity() * sizeof(std::uint16_t) + metres_.capacity() * sizeof(float);
  }
  bool operator==(const DepthMap&) const = default;

 private:
  static float metres_of(std::uint16_t mm) { return static_cast<float>(mm * 0.001); }
  std::vector<std::uint16_t> millimetres_;  // one of the two is empty
  std::vector<float> metres_;
};

/// A frame of a loaded scene; channels as in FrameBuffer, empty where the frame has none.
struct StoredFrame {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::uint8_t> rgb;  ///< [H * W * 3] as stored in the file
  DepthMap depth_m;
  LabelMap label;
  std::vector<std::int32_t> instance;
  PixelMask mask;
  std::vector<std::uint8_t> alpha;     ///< [H * W] of the channel `alpha`, 255: the subject covers the pixel
  std::vector<FrameChannel> channels;  ///< but `alpha`

  /// Whether no pixel of it counts, as of one that could not be read.
  bool is_unusable() const { return mask.masked_px() == std::int64_t{width_px} * height_px || rgb.empty(); }
  /// Null where the frame has none of the name.
  const FrameChannel* channel(std::string_view name) const;
  /// Its numbers at pixel `index`, row by row from the top; zeros where the frame has none.
  void read_channel(std::string_view name, std::int32_t index, std::span<float> out) const;

  StoredFrame() = default;
  explicit StoredFrame(FrameBuffer frame);
  std::size_t bytes() const;
};

}  // namespace semfield
