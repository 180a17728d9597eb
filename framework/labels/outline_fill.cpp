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
  PixelPoint top, bottom;
  double x_at(double y) const { return top.x + (y - top.y) * (bottom.x - top.x) / (bottom.y - top.y); }
};

// Pixel that x lies in; what lies outside counts for the first or last.
std::int32_t pixel_at(double x, std::int32_t end) {
  return static_cast<std::int32_t>(std::clamp(std::floor(x), 0.0, static_cast<double>(end - 1)));
}

struct RasterSize {
  std::int32_t width, height;
};

// Row y of a capsule, the disc on its way from a to b: convex, so one run. Together with the pixels of the line a-b.
PixelRun capsule_row(PixelPoint a, PixelPoint b, double radius_px, std::int32_t y, RasterSize size) {
  if (a.y > b.y) std::swap(a, b);
  const double center = y + 0.5;
  double lo = 1e300, hi = -1e300;
  const auto widen = [&](double x0, double x1) {
    lo = std::min(lo, x0);
    hi = std::max(hi, x1);
  };
  for (const PixelPoint& end : {a, b}) {
    const double dy = center - end.y;
    if (std::abs(dy) > radius_px) continue;
    const double half = std::sqrt(radius_px * radius_px - dy * dy);
    widen(end.x - half, end.x + half);
  }
  const double length = std::hypot(b.x - a.x, b.y - a.y);
  if (length > 0) {
    const PixelPoint side{(b.y - a.y) / length * radius_px, (a.x - b.x) / length * radius_px};
    const PixelPoint corners[] = {{a.x + side.x, a.y + side.y},
                                  {b.x + side.x, b.y + side.y},
                                  {b.x - side.x, b.y - side.y},
                                  {a.x - side.x, a.y - side.y}};
    for (int i = 0; i < 4; ++i) {
      PixelPoint from = corners[i], to = corners[(i + 1) % 4];
      if (from.y > to.y) std::swap(from, to);
      if (center < from.y || center > to.y || from.y == to.y) continue;
      const double x = from.x + (center - from.y) * (to.x - from.x) / (to.y - from.y);
      widen(x, x);
    }
  }
  PixelRun run{y, size.width, 0};
  if (lo <= hi) run = {y, first_at(lo, size.width), first_at(std::nextafter(hi, 1e30), size.width)};
  if (pixel_at(a.y, size.height) <= y && y <= pixel_at(b.y, size.height)) {
    const auto x_at = [&](double at) {
      return b.y > a.y ? a.x + (std::clamp(at, a.y, b.y) - a.y) / (b.y - a.y) * (b.x - a.x) : a.x;
    };
    const double x0 = x_at(y), x1 = b.y > a.y ? x_at(y + 1.0) : b.x;
    run.x0 = std::min(run.x0, pixel_at(std::min(x0, x1), size.width));
    run.x1 = std::max(run.x1, pixel_at(std::max(x0, x1), size.width) + 1);
  }
  return run;
}

}  // namespace

std::vector<PixelRun> outline_runs(const Outline& outline, std::int32_t width, std::int32_t height) {
  std::vector<Edge> edges;
  for (std::size_t i = 0; i < outline.size(); ++i) {
    PixelPoint a = outline[i], b = outline[(i + 1) % outline.size()];
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

std::vector<PixelRun> disc_runs(PixelPoint center, double radius_px, std::int32_t width, std::int32_t height) {
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

std::vector<PixelRun> stroke_runs(std::span<const PixelPoint> points, double radius_px, std::int32_t width,
                                  std::int32_t height) {
  std::vector<PixelRun> runs;
  if (points.empty()) return runs;
  const auto [top, bottom] = std::minmax_element(points.begin(), points.end(),
                                                 [](const PixelPoint& a, const PixelPoint& b) { return a.y < b.y; });
  const std::int32_t first = pixel_at(top->y - radius_px, height), last = pixel_at(bottom->y + radius_px, height);
  std::vector<PixelRun> row;
  for (std::int32_t y = first; y <= last; ++y) {
    row.clear();
    for (std::size_t i = 0; i == 0 || i + 1 < points.size(); ++i) {
      const PixelRun run =
          capsule_row(points[i], points[std::min(i + 1, points.size() - 1)], radius_px, y, {width, height});
      if (run.x0 < run.x1) row.push_back(run);
    }
    std::sort(row.begin(), row.end(), [](const PixelRun& a, const PixelRun& b) { return a.x0 < b.x0; });
    for (const PixelRun& run : row) {
      if (!runs.empty() && runs.back().y == y && run.x0 <= runs.back().x1) {
        runs.back().x1 = std::max(runs.back().x1, run.x1);
      } else {
        runs.push_back(run);
      }
    }
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
