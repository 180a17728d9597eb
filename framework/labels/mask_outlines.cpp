#include "labels/mask_outlines.h"

#include <array>

#include "core/check.h"

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
    for (std::int32_t y = 0; y < height; ++y) {
      for (std::int32_t x = 0; x < width; ++x) {
        const std::int16_t index = label[at(x, y)];
        if (index >= 0 && region_[at(x, y)] < 0) add_region(label, x, y, index);
      }
    }
    for (std::size_t r = 0; r < firsts_.size(); ++r) heads_.push_back(walk(firsts_[r].x, firsts_[r].y, kTop).first);
    // Columns ascending: a hole is met at its leftmost side, when all that lies left of it is joined already.
    for (std::int32_t x = 0; x < width; ++x) {
      for (std::int32_t y = 0; y < height; ++y) {
        if (region_[at(x, y)] >= 0 && (walked_[at(x, y)] >> kRight & 1) == 0 && !same(x, y, x + 1, y)) join_hole(x, y);
      }
    }
    for (std::size_t r = 0; r < regions_.size(); ++r) regions_[r].outline = corners(heads_[r]);
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

  void add_region(const std::vector<std::int16_t>& label, std::int32_t x, std::int32_t y, std::int16_t index) {
    const auto number = static_cast<std::int32_t>(regions_.size());
    MaskRegion region{index, 0, {}};
    std::vector<Step> open{{x, y}};
    region_[at(x, y)] = number;
    while (!open.empty()) {
      const Step pixel = open.back();
      open.pop_back();
      ++region.area_px;
      for (const Step& step : kOutward) {
        const Step next{pixel.x + step.x, pixel.y + step.y};
        if (next.x < 0 || next.y < 0 || next.x >= width_ || next.y >= height_) continue;
        if (region_[at(next.x, next.y)] >= 0 || label[at(next.x, next.y)] != index) continue;
        region_[at(next.x, next.y)] = number;
        open.push_back(next);
      }
    }
    regions_.push_back(std::move(region));
    firsts_.push_back({x, y});
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
  std::vector<Step> firsts_;         // of each region: its topmost pixel, the leftmost of them
  std::vector<std::int32_t> heads_;  // of each region: a node of its outline
};

}  // namespace

std::vector<MaskRegion> mask_regions(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height) {
  return Tracer(label, width, height).take();
}

}  // namespace semfield
