#include "serve/mark_pixels.h"

#include <algorithm>
#include <cmath>

namespace semfield {

namespace {

double distance_to(const PixelPoint& p, const PixelPoint& a, const PixelPoint& b) {
  const double dx = b.x - a.x, dy = b.y - a.y, square = dx * dx + dy * dy;
  const double along = square > 0 ? std::clamp(((p.x - a.x) * dx + (p.y - a.y) * dy) / square, 0.0, 1.0) : 0;
  return std::hypot(p.x - a.x - along * dx, p.y - a.y - along * dy);
}

std::int32_t pixel_in(double at, std::int32_t length_px) {
  return std::clamp(static_cast<std::int32_t>(std::floor(std::clamp(at, 0.0, static_cast<double>(length_px)))), 0,
                    length_px - 1);
}

}  // namespace

std::vector<PixelPlace> pixels_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px,
                                  std::span<const std::int16_t> painted) {
  std::vector<PixelPlace> out;
  if (mark.points.empty()) return out;
  std::vector<bool> taken(static_cast<std::size_t>(std::int64_t{width_px} * height_px), false);
  const auto take = [&](std::int32_t x, std::int32_t y) {
    const auto i = static_cast<std::size_t>(std::int64_t{y} * width_px + x);
    if (taken[i] || (!painted.empty() && painted[i] != mark.class_index)) return;
    taken[i] = true;
    out.push_back({x, y});
  };
  for (const PixelPoint& point : mark.points) take(pixel_in(point.x, width_px), pixel_in(point.y, height_px));
  for (std::size_t k = 0; k < mark.points.size(); ++k) {
    const PixelPoint &a = mark.points[k], &b = mark.points[std::min(k + 1, mark.points.size() - 1)];
    const double reach = std::max(mark.radius_px, 0.5);
    const std::int32_t x1 = pixel_in(std::max(a.x, b.x) + reach, width_px),
                       y1 = pixel_in(std::max(a.y, b.y) + reach, height_px);
    for (std::int32_t y = pixel_in(std::min(a.y, b.y) - reach, height_px); y <= y1; ++y)
      for (std::int32_t x = pixel_in(std::min(a.x, b.x) - reach, width_px); x <= x1; ++x)
        if (distance_to({x + 0.5, y + 0.5}, a, b) <= mark.radius_px) take(x, y);
  }
  return out;
}

}  // namespace semfield
