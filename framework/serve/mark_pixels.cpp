#include "serve/mark_pixels.h"

#include <algorithm>
#include <cmath>

namespace semfield {

namespace {

std::int32_t pixel_in(double at, std::int32_t length_px) {
  return static_cast<std::int32_t>(std::clamp(std::floor(at), 0.0, static_cast<double>(length_px - 1)));
}

}  // namespace

std::vector<PixelPlace> pixels_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px,
                                  std::span<const std::int16_t> painted) {
  std::vector<PixelPlace> out;
  if (mark.points.empty()) return out;
  const auto take = [&](std::int32_t x, std::int32_t y) {
    if (painted.empty() || painted[static_cast<std::size_t>(std::int64_t{y} * width_px + x)] == mark.class_index)
      out.push_back({x, y});
  };
  const std::vector<PixelRun> runs = runs_of(mark, width_px, height_px);
  PixelPlace first{pixel_in(mark.points[0].x, width_px), pixel_in(mark.points[0].y, height_px)};
  if (mark.fill && !runs.empty()) {  // a corner may lie outside of what an outline holds
    const PixelRun& middle = runs[runs.size() / 2];
    first = {(middle.x0 + middle.x1) / 2, middle.y};
  }
  take(first.column, first.row);
  for (const PixelRun& run : runs)
    for (std::int32_t x = run.x0; x < run.x1; ++x)
      if (x != first.column || run.y != first.row) take(x, run.y);
  return out;
}

}  // namespace semfield
