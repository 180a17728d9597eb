// Image textures with a mip pyramid, sampled in linear light.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

namespace semfield {

/// Repeating RGB texture, linear [0, 1].
class Texture {
 public:
  Texture() = default;
  /// `rgb` is sRGB-coded [H * W * 3], top row first.
  Texture(std::int32_t width, std::int32_t height, const std::vector<std::uint8_t>& rgb);
  /// Throws Error naming the file.
  static Texture load(const std::string& path);

  bool empty() const { return levels_.empty(); }
  std::int32_t width() const { return levels_.empty() ? 0 : levels_[0].width; }
  std::int32_t height() const { return levels_.empty() ? 0 : levels_[0].height; }
  /// Trilinear: (u, v) with v up as in OBJ files; `level` 0 = full size, each level halves it.
  std::array<float, 3> sample(float u, float v, float level) const;

 private:
  struct Level {
    std::int32_t width = 0, height = 0;
    std::vector<float> rgb;
  };
  std::array<float, 3> bilinear(const Level& level, float u, float v) const;
  std::vector<Level> levels_;
};

/// Repeating opacity mask [0, 1]: the image's alpha channel, or its brightness without one. Nearest texel.
class Mask {
 public:
  static Mask load(const std::string& path);
  bool empty() const { return values_.empty(); }
  bool opaque(float u, float v) const;

 private:
  std::int32_t width_ = 0, height_ = 0;
  std::vector<std::uint8_t> values_;
};

float linear_of_srgb(float value);
float srgb_of_linear(float value);

}  // namespace semfield
