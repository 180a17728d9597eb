#include "serve/label_upsampling.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <utility>

#include "compute/parallel.h"
#include "formats/image_io.h"
#include "serve/label_loop.h"

namespace semfield {

namespace {

constexpr float kColorSigma = 16;    // of 255
constexpr double kSameShape = 0.02;  // of the ratio of the sides: sizes are rounded to pixels

// exp(-d^2 / 2 s^2) of a squared difference of colours, by its root.
std::array<float, 512> color_weights() {
  std::array<float, 512> table{};
  for (std::size_t i = 0; i < table.size(); ++i) {
    const auto d = static_cast<float>(i);
    table[i] = std::exp(-0.5F * d * d / (kColorSigma * kColorSigma)) + 1e-6F;
  }
  return table;
}

}  // namespace

ViewLabels upsampled(const CoarseLabels& coarse, const StoredFrame& photo) {
  ViewLabels out;
  out.width_px = photo.width_px;
  out.height_px = photo.height_px;
  const std::int32_t width = photo.width_px, stride = coarse.stride;
  const auto size = static_cast<std::size_t>(std::int64_t{width} * photo.height_px);
  out.label.assign(size, kVoid);
  out.entropy.assign(size, 0);
  if (coarse.label.empty()) return out;
  if (stride == 1) {
    out.label = coarse.label;
    out.entropy = coarse.entropy;
    return out;
  }
  static const std::array<float, 512> weights = color_weights();
  const auto color = [&](std::int32_t x, std::int32_t y) {
    return &photo.rgb[3 * static_cast<std::size_t>(std::int64_t{y} * width + x)];
  };
  parallel_for(photo.height_px, [&](std::int64_t row) {
    const auto y = static_cast<std::int32_t>(row);
    const float v = (static_cast<float>(y) - static_cast<float>(stride / 2)) / static_cast<float>(stride);
    const auto y0 = static_cast<std::int32_t>(std::floor(v));
    for (std::int32_t x = 0; x < width; ++x) {
      const float u = (static_cast<float>(x) - static_cast<float>(stride / 2)) / static_cast<float>(stride);
      const auto x0 = static_cast<std::int32_t>(std::floor(u));
      const std::uint8_t* const own = color(x, y);
      std::array<std::int16_t, 4> label{};
      std::array<float, 4> weight{};
      float entropy = 0, sum = 0;
      for (int k = 0; k < 4; ++k) {
        const std::int32_t cx = std::clamp(x0 + (k & 1), 0, coarse.width_px - 1),
                           cy = std::clamp(y0 + (k >> 1), 0, coarse.height_px - 1);
        const std::uint8_t* const other = color(cx * stride + stride / 2, cy * stride + stride / 2);
        float square = 0;
        for (int c = 0; c < 3; ++c) {
          const auto d = static_cast<float>(int{own[c]} - int{other[c]});
          square += d * d;
        }
        const float near_x = 1 - std::abs(u - static_cast<float>(x0 + (k & 1))),
                    near_y = 1 - std::abs(v - static_cast<float>(y0 + (k >> 1)));
        const auto at = static_cast<std::size_t>(std::int64_t{cy} * coarse.width_px + cx);
        const auto n = static_cast<std::size_t>(k);
        weight[n] = (near_x * near_y + 0.02F) * weights[static_cast<std::size_t>(std::sqrt(square))];
        label[n] = coarse.label[at];
        entropy += weight[n] * static_cast<float>(coarse.entropy[at]);
        sum += weight[n];
      }
      float best = -1;
      std::int16_t chosen = kVoid;
      for (std::size_t a = 0; a < 4; ++a) {
        float votes = 0;
        for (std::size_t b = 0; b < 4; ++b) votes += label[b] == label[a] ? weight[b] : 0.0F;
        if (votes > best) {
          best = votes;
          chosen = label[a];
        }
      }
      const auto at = static_cast<std::size_t>(std::int64_t{y} * width + x);
      out.label[at] = chosen;
      out.entropy[at] = static_cast<std::uint8_t>(std::lround(entropy / sum));
    }
  });
  return out;
}

std::optional<StoredSize> stored_size_of(const FrameInfo& frame) {
  std::error_code failed;
  if (!std::filesystem::is_regular_file(frame.source, failed)) return std::nullopt;
  const ImageSize stored = image_size(frame.source);
  const Camera& camera = frame.camera;
  const double x = static_cast<double>(stored.width_px) / camera.width_px,
               y = static_cast<double>(stored.height_px) / camera.height_px;
  if (std::abs(x / y - 1) > kSameShape || (stored.width_px <= camera.width_px && stored.height_px <= camera.height_px))
    return std::nullopt;
  return StoredSize{camera.resized(stored.width_px, stored.height_px),
                    std::max(1, static_cast<std::int32_t>(std::lround(std::sqrt(x * y)))), frame.source};
}

std::vector<std::int16_t> labels_at(const StoredSize& size, RenderedFrame rendered) {
  if (size.stride == 1) return std::move(rendered.label);
  StoredFrame photo;
  Image<std::uint8_t> image = read_rgb(size.image);
  photo.width_px = image.width_px;
  photo.height_px = image.height_px;
  photo.rgb = std::move(image.pixels);
  CoarseLabels coarse{size.stride, rendered.width_px, rendered.height_px, std::move(rendered.label), {}};
  coarse.entropy.assign(coarse.label.size(), 0);
  return upsampled(coarse, photo).label;
}

}  // namespace semfield
