// Texture lookup: pyramid by box filter, bilinear in each level, linear between levels.
#include "datasets/obj_room/texture.h"

#include <algorithm>
#include <cmath>

#include "core/error.h"
#include "formats/image_io.h"

namespace semfield {

// IEC 61966-2-1.
float linear_of_srgb(float value) {
  return value <= 0.04045f ? value / 12.92f : std::pow((value + 0.055f) / 1.055f, 2.4f);
}
float srgb_of_linear(float value) {
  return value <= 0.0031308f ? value * 12.92f : 1.055f * std::pow(value, 1 / 2.4f) - 0.055f;
}

Texture::Texture(std::int32_t width, std::int32_t height, const std::vector<std::uint8_t>& rgb) {
  std::array<float, 256> table{};
  for (std::size_t i = 0; i < 256; ++i) table[i] = linear_of_srgb(static_cast<float>(i) / 255.0f);
  Level base{width, height, std::vector<float>(rgb.size())};
  for (std::size_t i = 0; i < rgb.size(); ++i) base.rgb[i] = table[rgb[i]];
  levels_.push_back(std::move(base));
  while (levels_.back().width > 1 || levels_.back().height > 1) {
    const Level& fine = levels_.back();
    Level coarse{std::max(1, fine.width / 2), std::max(1, fine.height / 2), {}};
    coarse.rgb.resize(static_cast<std::size_t>(coarse.width) * static_cast<std::size_t>(coarse.height) * 3);
    for (std::int32_t y = 0; y < coarse.height; ++y) {
      for (std::int32_t x = 0; x < coarse.width; ++x) {
        for (std::int32_t c = 0; c < 3; ++c) {
          float sum = 0;
          for (std::int32_t k = 0; k < 4; ++k) {
            const std::int32_t sx = std::min(2 * x + (k & 1), fine.width - 1);
            const std::int32_t sy = std::min(2 * y + (k >> 1), fine.height - 1);
            sum += fine.rgb[static_cast<std::size_t>((sy * fine.width + sx) * 3 + c)];
          }
          coarse.rgb[static_cast<std::size_t>((y * coarse.width + x) * 3 + c)] = sum * 0.25f;
        }
      }
    }
    levels_.push_back(std::move(coarse));
  }
}

Texture Texture::load(const std::string& path) {
  const Image<std::uint8_t> image = read_rgb(path);
  return Texture(image.width_px, image.height_px, image.pixels);
}

std::array<float, 3> Texture::bilinear(const Level& level, float u, float v) const {
  const float x = (u - std::floor(u)) * static_cast<float>(level.width) - 0.5f;
  const float y = (1 - (v - std::floor(v))) * static_cast<float>(level.height) - 0.5f;
  const float fx = x - std::floor(x), fy = y - std::floor(y);
  const auto wrap = [](float a, std::int32_t n) {
    const std::int32_t i = static_cast<std::int32_t>(std::floor(a)) % n;
    return i < 0 ? i + n : i;
  };
  const std::int32_t x0 = wrap(x, level.width), x1 = (x0 + 1) % level.width;
  const std::int32_t y0 = wrap(y, level.height), y1 = (y0 + 1) % level.height;
  const auto at = [&](std::int32_t px, std::int32_t py) {
    return &level.rgb[static_cast<std::size_t>(py * level.width + px) * 3];
  };
  const float *a = at(x0, y0), *b = at(x1, y0), *c = at(x0, y1), *d = at(x1, y1);
  std::array<float, 3> out{};
  for (std::size_t k = 0; k < 3; ++k) {
    const float top = a[k] + (b[k] - a[k]) * fx, bottom = c[k] + (d[k] - c[k]) * fx;
    out[k] = top + (bottom - top) * fy;
  }
  return out;
}

std::array<float, 3> Texture::sample(float u, float v, float level) const {
  if (!std::isfinite(u) || !std::isfinite(v)) return {0.5f, 0.5f, 0.5f};
  const float top = static_cast<float>(levels_.size() - 1);
  const float clamped = level > 0 ? std::min(level, top) : 0.0f;
  const auto i = static_cast<std::size_t>(clamped);
  const float f = clamped - static_cast<float>(i);
  std::array<float, 3> a = bilinear(levels_[i], u, v);
  if (f > 0 && i + 1 < levels_.size()) {
    const std::array<float, 3> b = bilinear(levels_[i + 1], u, v);
    for (std::size_t k = 0; k < 3; ++k) a[k] += (b[k] - a[k]) * f;
  }
  return a;
}

Mask Mask::load(const std::string& path) {
  Mask mask;
  const std::int32_t channels = image_size(path).channels;
  const bool has_alpha = channels == 4 || channels == 2;
  const Image<std::uint8_t> black = read_rgb(path, has_alpha ? 0 : -1);
  mask.width_ = black.width_px;
  mask.height_ = black.height_px;
  mask.values_.resize(black.pixels.size() / 3);
  if (has_alpha) {
    // Over white minus over black is 255 (1 - alpha).
    const Image<std::uint8_t> white = read_rgb(path, 255);
    for (std::size_t i = 0; i < mask.values_.size(); ++i) {
      mask.values_[i] =
          static_cast<std::uint8_t>(std::clamp(255 - (white.pixels[3 * i] - black.pixels[3 * i]), 0, 255));
    }
  } else {
    for (std::size_t i = 0; i < mask.values_.size(); ++i) {
      mask.values_[i] =
          static_cast<std::uint8_t>((black.pixels[3 * i] + black.pixels[3 * i + 1] + black.pixels[3 * i + 2]) / 3);
    }
  }
  return mask;
}

bool Mask::opaque(float u, float v) const {
  if (!std::isfinite(u) || !std::isfinite(v)) return true;
  const auto x = std::min(static_cast<std::int32_t>((u - std::floor(u)) * static_cast<float>(width_)), width_ - 1);
  const auto y =
      std::min(static_cast<std::int32_t>((1 - (v - std::floor(v))) * static_cast<float>(height_)), height_ - 1);
  return values_[static_cast<std::size_t>(y * width_ + x)] >= 128;
}

}  // namespace semfield
