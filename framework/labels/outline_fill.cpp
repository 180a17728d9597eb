#include "labels/outline_fill.h"

#include <algorithm>
#include <cmath>

#include "formats/png_codec.h"

namespace semfield {

namespace {

// First pixel whose centre is at or right of x.
std::int32_t first_at(double x, std::int32_t end) {
  return static_cast<std::int32_t>(std::clamp(std::ceil(x - 0.5), 0.0, static_cast<double>(end)));
}

// Edge that crosses the centres of rows first .. end - 1; `top` is its upper point.
struct Edge {
  std::int32_t first, end;
  ImagePoint top, bottom;
  double x_at(double y) const { return top.x + (y - top.y) * (bottom.x - top.x) / (bottom.y - top.y); }
};

}  // namespace

std::vector<PixelRun> outline_runs(const Outline& outline, std::int32_t width, std::int32_t height) {
  std::vector<Edge> edges;
  for (std::size_t i = 0; i < outline.size(); ++i) {
    ImagePoint a = outline[i], b = outline[(i + 1) % outline.size()];
    if (a.y > b.y) std::swap(a, b);
    // Half-open: a centre line through a shared point meets one of the two edges.
    const Edge edge{first_at(a.y, height), first_at(b.y, height), a, b};
    if (edge.first < edge.end) edges.push_back(edge);
  }
  std::sort(edges.begin(), edges.end(), [](const Edge& a, const Edge& b) { return a.first < b.first; });

  std::vector<PixelRun> runs;
  std::vector<const Edge*> active;
  std::vector<double> crossings;
  std::size_t next = 0;
  for (std::int32_t y = edges.empty() ? height : edges.front().first; y < height; ++y) {
    std::erase_if(active, [&](const Edge* e) { return e->end <= y; });
    for (; next < edges.size() && edges[next].first <= y; ++next) active.push_back(&edges[next]);
    if (active.empty() && next == edges.size()) break;
    crossings.clear();
    for (const Edge* edge : active) crossings.push_back(edge->x_at(y + 0.5));
    std::sort(crossings.begin(), crossings.end());
    for (std::size_t k = 0; k + 1 < crossings.size(); k += 2) {
      const PixelRun run{y, first_at(crossings[k], width), first_at(crossings[k + 1], width)};
      if (run.x0 < run.x1) runs.push_back(run);
    }
  }
  return runs;
}

std::vector<PixelRun> disc_runs(ImagePoint center, double radius_px, std::int32_t width, std::int32_t height) {
  std::vector<PixelRun> runs;
  const std::int32_t end = first_at(std::nextafter(center.y + radius_px, 1e30), height);
  for (std::int32_t y = first_at(center.y - radius_px, height); y < end; ++y) {
    const double dy = y + 0.5 - center.y;
    const double half = std::sqrt(std::max(0.0, radius_px * radius_px - dy * dy));
    const PixelRun run{y, first_at(center.x - half, width), first_at(std::nextafter(center.x + half, 1e30), width)};
    if (run.x0 < run.x1) runs.push_back(run);
  }
  return runs;
}

std::int64_t area_of(const std::vector<PixelRun>& runs) {
  std::int64_t area = 0;
  for (const PixelRun& run : runs) area += run.x1 - run.x0;
  return area;
}

LabelRaster void_raster(std::int32_t width, std::int32_t height) {
  check_image_limits(width, height);
  LabelRaster raster{width, height, {}, {}};
  raster.hard.assign(static_cast<std::size_t>(width) * static_cast<std::size_t>(height), kVoid);
  return raster;
}

void paint(const std::vector<PixelRun>& runs, std::int16_t index, LabelRaster& raster) {
  for (const PixelRun& run : runs) {
    const auto row = raster.hard.begin() + std::int64_t{run.y} * raster.width_px;
    std::fill(row + run.x0, row + run.x1, index);
  }
}

}  // namespace semfield
