#include "labels/mask_outlines.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "core/check.h"
#include "formats/image_io.h"

namespace semfield {

namespace {

// Sides of a pixel, clockwise: top, right, bottom, left. An outline walks along them with the region on its right.
struct Step {
  std::int32_t x, y;
};
constexpr std::array<Step, 4> kAlong{{{1, 0}, {0, 1}, {-1, 0}, {0, -1}}};
constexpr std::array<Step, 4> kOutward{{{0, -1}, {1, 0}, {0, 1}, {-1, 0}}};
constexpr std::array<Step, 4> kSideEnd{{{1, 0}, {1, 1}, {0, 1}, {0, 0}}};  // of the pixel's own corners
constexpr int kTop = 0, kRight = 1, kLeft = 3;

struct Node {
  std::int32_t x, y, next;
};

class Tracer {
 public:
  Tracer(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height)
      : width_(width), height_(height), region_(label.size(), -1), walked_(label.size()), left_node_(label.size(), -1) {
    SEMFIELD_CHECK(std::int64_t{width} * height == std::ssize(label), "label map of another size");
    const PixelRegions all = regions_of(label, width, height);
    std::vector<std::int32_t> number(all.first.size(), -1), heads;
    for (std::size_t r = 0; r < all.first.size(); ++r) {
      if (label[all.first[r]] < 0) continue;
      number[r] = static_cast<std::int32_t>(regions_.size());
      regions_.push_back({label[all.first[r]], all.pixels[r], {}});
    }
    for (std::size_t i = 0; i < label.size(); ++i) region_[i] = number[all.of_pixel[i]];
    for (std::size_t r = 0; r < all.first.size(); ++r) {
      const auto first = static_cast<std::int64_t>(all.first[r]);
      if (number[r] >= 0)
        heads.push_back(
            walk(static_cast<std::int32_t>(first % width), static_cast<std::int32_t>(first / width), kTop).first);
    }
    // Columns ascending: a hole is met at its leftmost side, when all that lies left of it is joined already.
    for (std::int32_t x = 0; x < width; ++x) {
      for (std::int32_t y = 0; y < height; ++y) {
        if (region_[at(x, y)] >= 0 && (walked_[at(x, y)] >> kRight & 1) == 0 && !same(x, y, x + 1, y)) join_hole(x, y);
      }
    }
    for (std::size_t r = 0; r < regions_.size(); ++r) regions_[r].outline = corners(heads[r]);
  }

  std::vector<MaskRegion> take() { return std::move(regions_); }

 private:
  std::size_t at(std::int32_t x, std::int32_t y) const {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
  }
  bool same(std::int32_t x, std::int32_t y, std::int32_t other_x, std::int32_t other_y) const {
    return other_x >= 0 && other_y >= 0 && other_x < width_ && other_y < height_ &&
           region_[at(x, y)] == region_[at(other_x, other_y)];
  }

  // Walks one closed outline from a side of a pixel; returns its first and last node.
  std::pair<std::int32_t, std::int32_t> walk(std::int32_t x, std::int32_t y, int side) {
    const auto first = static_cast<std::int32_t>(nodes_.size());
    while ((walked_[at(x, y)] >> side & 1) == 0) {
      walked_[at(x, y)] = static_cast<std::uint8_t>(walked_[at(x, y)] | 1 << side);
      const auto s = static_cast<std::size_t>(side);
      const auto node = static_cast<std::int32_t>(nodes_.size());
      if (side == kLeft) left_node_[at(x, y)] = node;
      nodes_.push_back({x + kSideEnd[s].x, y + kSideEnd[s].y, node + 1});
      const Step ahead{x + kAlong[s].x, y + kAlong[s].y};
      if (!same(x, y, ahead.x, ahead.y)) {  // around this pixel's corner
        side = (side + 1) % 4;
        continue;
      }
      const Step across{ahead.x + kOutward[s].x, ahead.y + kOutward[s].y};
      const bool turn = same(x, y, across.x, across.y);
      x = turn ? across.x : ahead.x;
      y = turn ? across.y : ahead.y;
      if (turn) side = (side + 3) % 4;
    }
    const auto last = static_cast<std::int32_t>(nodes_.size()) - 1;
    nodes_[static_cast<std::size_t>(last)].next = first;
    return {first, last};
  }

  // The hole right of pixel (x, y), joined along the upper edge of row y to the region's side at the left end of the
  // pixel's run.
  void join_hole(std::int32_t x, std::int32_t y) {
    const auto [first, last] = walk(x, y, kRight);
    std::int32_t left = x;
    while (same(x, y, left - 1, y)) --left;
    const std::int32_t from = left_node_[at(left, y)];
    SEMFIELD_CHECK(from >= 0, "a hole before what surrounds it");
    Node& before = nodes_[static_cast<std::size_t>(from)];
    const std::int32_t after = before.next;
    const auto there = static_cast<std::int32_t>(nodes_.size());
    before.next = there;
    nodes_.push_back({x + 1, y, first});
    nodes_.push_back({left, y, after});
    nodes_[static_cast<std::size_t>(last)].next = there + 1;
  }

  // b lies between a and c: at the end of a cut, where the way leads back, it does not.
  static bool between(Step a, Step b, Step c) {
    const bool vertical = a.x == b.x && b.x == c.x && (b.y - a.y > 0) == (c.y - b.y > 0);
    const bool horizontal = a.y == b.y && b.y == c.y && (b.x - a.x > 0) == (c.x - b.x > 0);
    return vertical || horizontal;
  }

  Outline corners(std::int32_t head) const {
    std::vector<Step> points;
    std::int32_t node = head;
    do {
      const Node& n = nodes_[static_cast<std::size_t>(node)];
      if (points.size() >= 2 && between(points[points.size() - 2], points.back(), {n.x, n.y})) points.pop_back();
      points.push_back({n.x, n.y});
      node = n.next;
    } while (node != head);
    if (between(points[points.size() - 2], points.back(), points[0])) points.pop_back();
    if (between(points.back(), points[0], points[1])) points.erase(points.begin());
    Outline outline;
    for (const Step& p : points) outline.push_back({static_cast<double>(p.x), static_cast<double>(p.y)});
    return outline;
  }

  std::int32_t width_, height_;
  std::vector<std::int32_t> region_;     // of each pixel; -1 = void
  std::vector<std::uint8_t> walked_;     // bit s: side s of the pixel is part of an outline
  std::vector<std::int32_t> left_node_;  // node at the upper end of the pixel's left side
  std::vector<Node> nodes_;
  std::vector<MaskRegion> regions_;
};

}  // namespace

std::vector<MaskRegion> mask_regions(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height) {
  return Tracer(label, width, height).take();
}

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

namespace {

[[noreturn]] void refuse(const std::string& message) {
  throw Error(ErrorKind::data, "labels.run_lengths.damaged", "run lengths: " + message, "export the annotation again");
}

}  // namespace

std::vector<std::int64_t> counts_of_text(std::string_view text) {
  std::vector<std::int64_t> counts;
  for (std::size_t at = 0; at < text.size();) {
    std::uint64_t value = 0;
    for (int shift = 0;; shift += 5) {
      if (at == text.size()) refuse("the text ends within a number");
      if (shift > 35) refuse("number " + std::to_string(counts.size() + 1) + " is too large");
      const char c = text[at++];
      if (c < '0' || c > 'o') refuse("character " + std::to_string(at) + " does not belong to such a text");
      const auto bits = static_cast<std::uint64_t>(c - '0');
      value |= (bits & 0x1F) << shift;
      if ((bits & 0x20) != 0) continue;
      if ((bits & 0x10) != 0) value |= ~std::uint64_t{0} << (shift + 5);
      break;
    }
    auto count = static_cast<std::int64_t>(value);
    if (counts.size() > 2) count += counts[counts.size() - 2];
    if (count < 0) refuse("count " + std::to_string(counts.size() + 1) + " is negative");
    counts.push_back(count);
  }
  return counts;
}

std::string text_of_counts(const std::vector<std::int64_t>& counts) {
  std::string text;
  for (std::size_t i = 0; i < counts.size(); ++i) {
    std::int64_t value = counts[i] - (i > 2 ? counts[i - 2] : 0);
    for (bool more = true; more;) {
      std::int64_t bits = value & 0x1F;
      value >>= 5;
      more = (bits & 0x10) != 0 ? value != -1 : value != 0;
      if (more) bits |= 0x20;
      text += static_cast<char>('0' + bits);
    }
  }
  return text;
}

std::vector<PixelRun> runs_of_counts(const std::vector<std::int64_t>& counts, std::int32_t width, std::int32_t height) {
  const std::int64_t pixels = std::int64_t{width} * height;
  std::int64_t sum = 0;
  for (const std::int64_t count : counts) {
    if (count < 0 || count > pixels - sum) {
      refuse(count < 0
                 ? "a count is negative"
                 : "they run past the end of an image of " + std::to_string(width) + " x " + std::to_string(height));
    }
    sum += count;
  }
  if (sum != pixels) {
    refuse("they cover " + std::to_string(sum) + " of " + std::to_string(pixels) + " pixels of an image of " +
           std::to_string(width) + " x " + std::to_string(height));
  }
  std::vector<char> mask(static_cast<std::size_t>(pixels));
  std::int64_t at = 0;
  bool inside = false;
  for (const std::int64_t count : counts) {
    for (const std::int64_t end = at + count; inside && at < end; ++at)
      mask[static_cast<std::size_t>(at % height * width + at / height)] = 1;
    if (!inside) at += count;
    inside = !inside;
  }
  std::vector<PixelRun> runs;
  for (std::int32_t y = 0; y < height; ++y) {
    const auto row = mask.begin() + std::int64_t{y} * width, end = row + width;
    for (auto x0 = std::find(row, end, 1); x0 != end;) {
      const auto x1 = std::find(x0, end, 0);
      runs.push_back({y, static_cast<std::int32_t>(x0 - row), static_cast<std::int32_t>(x1 - row)});
      x0 = std::find(x1, end, 1);
    }
  }
  return runs;
}

std::vector<std::int64_t> counts_of_class(const std::vector<std::int16_t>& label, std::int16_t index,
                                          std::int32_t width, std::int32_t height) {
  std::vector<std::int64_t> counts{0};
  bool inside = false;
  for (std::int32_t x = 0; x < width; ++x) {
    for (std::int32_t y = 0; y < height; ++y) {
      const bool here = label[static_cast<std::size_t>(std::int64_t{y} * width + x)] == index;
      if (here != inside) counts.push_back(0);
      inside = here;
      ++counts.back();
    }
  }
  return counts;
}

namespace {

// Pixels that share an edge with pixel `i`; -1 beyond the border.
std::array<std::int64_t, 4> neighbours(std::int64_t i, std::int32_t width, std::int32_t height) {
  const std::int64_t column = i % width, row = i / width;
  return {row > 0 ? i - width : -1, column > 0 ? i - 1 : -1, column + 1 < width ? i + 1 : -1,
          row + 1 < height ? i + width : -1};
}

}  // namespace

PixelRegions regions_of(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height) {
  constexpr auto kNone = static_cast<std::uint32_t>(-1);
  PixelRegions out;
  out.of_pixel.assign(label.size(), kNone);
  std::vector<std::int64_t> queue;
  for (std::size_t start = 0; start < label.size(); ++start) {
    if (out.of_pixel[start] != kNone) continue;
    const auto number = static_cast<std::uint32_t>(out.first.size());
    queue.assign(1, static_cast<std::int64_t>(start));
    out.of_pixel[start] = number;
    for (std::size_t next = 0; next < queue.size(); ++next) {
      for (const std::int64_t n : neighbours(queue[next], width, height)) {
        const auto pixel = static_cast<std::size_t>(n);
        if (n < 0 || out.of_pixel[pixel] != kNone || label[pixel] != label[start]) continue;
        out.of_pixel[pixel] = number;
        queue.push_back(n);
      }
    }
    out.first.push_back(start);
    out.pixels.push_back(std::ssize(queue));
  }
  return out;
}

SmallRegions fill_small_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                                std::int64_t min_area_px) {
  SEMFIELD_CHECK(std::ssize(label) == std::int64_t{width} * height, "a label map has a label for each pixel");
  const PixelRegions regions = regions_of(label, width, height);
  std::vector<bool> small;
  for (const std::int64_t pixels : regions.pixels) small.push_back(pixels < min_area_px);
  return fill_regions(label, width, height, regions, small);
}

SmallRegions fill_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                          const PixelRegions& regions, const std::vector<bool>& weak) {
  SmallRegions found;
  for (std::size_t r = 0; r < weak.size(); ++r) {
    if (!weak[r]) continue;
    ++found.regions;
    found.pixels += regions.pixels[r];
  }
  if (found.pixels == std::ssize(label)) return {};
  // The others grow into them from all sides, a pixel at a time: what they fill is connected to them.
  std::vector<bool> small(label.size());
  std::vector<std::int64_t> queue;
  for (std::size_t i = 0; i < label.size(); ++i) {
    small[i] = weak[regions.of_pixel[i]];
    if (!small[i]) queue.push_back(static_cast<std::int64_t>(i));
  }
  for (std::size_t next = 0; next < queue.size(); ++next) {
    for (const std::int64_t n : neighbours(queue[next], width, height)) {
      if (n < 0 || !small[static_cast<std::size_t>(n)]) continue;
      small[static_cast<std::size_t>(n)] = false;
      label[static_cast<std::size_t>(n)] = label[static_cast<std::size_t>(queue[next])];
      queue.push_back(n);
    }
  }
  return found;
}

}  // namespace semfield
