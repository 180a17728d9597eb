#include "surface/things.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>
#include <queue>
#include <tuple>
#include <utility>

#include "core/check.h"
#include "core/joined_sets.h"

namespace semfield {

namespace {

// Of the first, small regions.
constexpr double kRegionScale = 0.5;      // a region of n pixels takes steps of up to this / n more than it has
constexpr double kRegionPixels = 12'960;  // a region is at least the picture's pixels by this large
constexpr double kLeastPixels = 8;
constexpr double kJump = 0.02;         // of the distance: what differs more lies on two surfaces
constexpr double kJumpWeight = 4;      // per share of the distance
constexpr double kTurnWeight = 0.3;    // of 1 - cosine of two normals
constexpr double kSameSurface = 0.03;  // of the distance: pixels whose normals are averaged
constexpr std::int32_t kSharpWidth =
    400;                              // a wider picture is softer than its pixels: borders are compared farther off
constexpr std::size_t kSteps = 4096;  // of weights in the order of joining
constexpr double kMostWeight = 4;

// Of the border of two regions: of a step that nobody overlooks.
constexpr double kClearColor = 0.15, kClearGap = 0.03;

// Log odds that two regions belong to two things.
struct BorderWeights {
  double always = -1.804, color = 0.145, color_by_texture = 0.438, step = -2.864, turn = 0.839, offset = 2.394,
         smaller = 3.301, shared = -1.016, root_color = 1.875, root_step = 3.138, clear = 1.589;
};
// How much a node looks like what a person means by a click.
struct ThingWeights {
  double jump = 0.766, share = -2.517, rim = -15.891, filled = 7.147, outline = 2.213, stays = 0.682, inside = 24.652;
};
constexpr BorderWeights kBorderOdds;
constexpr double kSegmentOdds = 5;  // of a border that segments share all along; far more than what pixels say
constexpr ThingWeights kThingOdds;
constexpr double kLowest = -4, kHighest = 6;  // of log odds that are compared
constexpr double kLeastThing = 3240;          // a thing is at least the picture's pixels by this large
constexpr double kLevelStep = 1.2;            // ratio of sizes between two levels
constexpr int kRays = 16;                     // to the outline from a place in it

double spread_of(const Vec3d& mean, const Vec3d& square) {
  double sum = 0;
  for (int c = 0; c < 3; ++c) sum += std::max(0.0, square[c] - mean[c] * mean[c]);
  return sum;
}

double steps_of_color(const Vec3d& a, const Vec3d& b) {
  return std::abs(a.x - b.x) + std::abs(a.y - b.y) + std::abs(a.z - b.z);
}

// Normals averaged over neighbours on the same surface; those of one pixel are noisy.
std::vector<Vec3d> smooth_normals(const SeenSurface& seen, std::int32_t radius) {
  std::vector<Vec3d> out(seen.normal.size());
  for (std::int32_t y = 0; y < seen.height_px; ++y) {
    for (std::int32_t x = 0; x < seen.width_px; ++x) {
      const auto at = static_cast<std::size_t>(std::int64_t{y} * seen.width_px + x);
      const double own = seen.distance_m[at];
      Vec3d total;
      for (std::int32_t v = std::max(0, y - radius); v <= std::min(seen.height_px - 1, y + radius); ++v) {
        for (std::int32_t u = std::max(0, x - radius); u <= std::min(seen.width_px - 1, x + radius); ++u) {
          const auto other = static_cast<std::size_t>(std::int64_t{v} * seen.width_px + u);
          if (std::abs(seen.distance_m[other] - own) < kSameSurface * own) total = total + seen.normal[other];
        }
      }
      const double size = length(total);
      if (size > 0) out[at] = total * (1 / size);
    }
  }
  return out;
}

}  // namespace

void ThingTree::Region::add(const Region& other) {
  pixels += other.pixels;
  rim += other.rim;
  seen += other.seen;
  distance += other.distance;
  color = color + other.color;
  square = square + other.square;
  place = place + other.place;
  normal = normal + other.normal;
  for (std::size_t k = 0; k < 4; ++k) box[k] = k < 2 ? std::min(box[k], other.box[k]) : std::max(box[k], other.box[k]);
}

struct ThingTree::Pixel {
  Vec3d color;
  Vec3d place, normal;
  double distance = 0;  // 0: nothing is known
  std::int32_t segment = 0;
};

void ThingTree::Border::add(const Border& other) {
  length += other.length;
  step += other.step;
  clear += other.clear;
  segments += other.segments;
}

std::vector<ThingTree::Pixel> ThingTree::pixels_of(const ThingPicture& picture) const {
  std::vector<Pixel> out(leaf_.size());
  const bool soft = reach_px_ > 1;
  const auto weight = [&](std::int32_t off) { return off == 0 ? 2.0 : soft ? 1.0 : 0.0; };
  std::vector<Vec3d> normals;
  const SeenSurface* const seen = picture.surface;
  if (seen != nullptr) normals = smooth_normals(*seen, 4 * seen->width_px >= width_px_ ? 2 : 1);
  for (std::int32_t y = 0; y < height_px_; ++y) {
    for (std::int32_t x = 0; x < width_px_; ++x) {
      Pixel& pixel = out[static_cast<std::size_t>(std::int64_t{y} * width_px_ + x)];
      double total = 0;
      for (std::int32_t dy = -1; dy <= 1; ++dy) {
        for (std::int32_t dx = -1; dx <= 1; ++dx) {
          const double share = weight(dx) * weight(dy);
          if (share == 0) continue;
          const std::int32_t u = std::clamp(x + dx, 0, width_px_ - 1), v = std::clamp(y + dy, 0, height_px_ - 1);
          const std::uint8_t* const rgb = &picture.rgb[3 * static_cast<std::size_t>(std::int64_t{v} * width_px_ + u)];
          pixel.color = pixel.color + Vec3d{double(rgb[0]), double(rgb[1]), double(rgb[2])} * share;
          total += share;
        }
      }
      pixel.color = pixel.color * (1 / (255 * total));
      if (!picture.segment.empty())
        pixel.segment = picture.segment[static_cast<std::size_t>(std::int64_t{y} * width_px_ + x)];
      if (seen == nullptr) continue;
      const std::int64_t column = std::int64_t{x} * seen->width_px / width_px_,
                         row = std::int64_t{y} * seen->height_px / height_px_;
      const auto at = static_cast<std::size_t>(row * seen->width_px + column);
      if (!(seen->distance_m[at] > 0)) continue;
      pixel.place = seen->place[at];
      pixel.normal = normals[at];
      pixel.distance = seen->distance_m[at];
    }
  }
  return out;
}

void ThingTree::find_regions(const std::vector<Pixel>& pixels) {
  struct Edge {
    std::int32_t a, b;
    float weight;
  };
  const auto weight_of = [](const Pixel& a, const Pixel& b) {
    if (a.segment != b.segment) return static_cast<float>(kMostWeight);
    double weight = steps_of_color(a.color, b.color);
    if (a.distance > 0 && b.distance > 0) {
      const double jump = std::abs(a.distance - b.distance) / std::min(a.distance, b.distance);
      weight += kJumpWeight * std::max(0.0, jump - kJump) + kTurnWeight * (1 - dot(a.normal, b.normal));
    }
    return static_cast<float>(std::min(weight, kMostWeight));
  };
  // In the order of their weights, in steps, by counting.
  std::vector<Edge> found;
  found.reserve(2 * pixels.size());
  std::vector<std::size_t> begin(kSteps + 1, 0);
  const auto step_of = [](float weight) {
    return static_cast<std::size_t>(static_cast<double>(weight) * ((kSteps - 1) / kMostWeight));
  };
  const auto add = [&](std::int32_t a, std::int32_t b) {
    const float weight = weight_of(pixels[static_cast<std::size_t>(a)], pixels[static_cast<std::size_t>(b)]);
    found.push_back({a, b, weight});
    ++begin[step_of(weight) + 1];
  };
  for (std::int32_t y = 0; y < height_px_; ++y) {
    for (std::int32_t x = 0; x < width_px_; ++x) {
      const std::int32_t at = y * width_px_ + x;
      if (x + 1 < width_px_) add(at, at + 1);
      if (y + 1 < height_px_) add(at, at + width_px_);
    }
  }
  for (std::size_t s = 1; s < begin.size(); ++s) begin[s] += begin[s - 1];
  std::vector<Edge> edges(found.size());
  for (const Edge& edge : found) edges[begin[step_of(edge.weight)]++] = edge;

  JoinedSets sets(pixels.size());
  std::vector<std::int32_t> size(pixels.size(), 1);
  std::vector<float> most(pixels.size(), static_cast<float>(kRegionScale));
  const auto join_where = [&](const auto& may_join) {
    for (const Edge& edge : edges) {
      const auto a = static_cast<std::size_t>(sets.of(edge.a)), b = static_cast<std::size_t>(sets.of(edge.b));
      if (a == b || !may_join(a, b, edge.weight)) continue;
      sets.join(a, b);
      const std::size_t both = std::min(a, b);
      size[both] = size[a] + size[b];
      most[both] = edge.weight + static_cast<float>(kRegionScale / size[both]);
    }
  };
  join_where([&](std::size_t a, std::size_t b, float weight) { return weight <= most[a] && weight <= most[b]; });
  const double least = std::max(kLeastPixels, static_cast<double>(pixels.size()) / kRegionPixels);
  join_where([&](std::size_t a, std::size_t b, float) { return size[a] < least || size[b] < least; });

  std::vector<std::int32_t> number(pixels.size(), -1);
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    std::int32_t& own = number[sets.of(i)];
    if (own < 0) {
      own = leaves_++;
      nodes_.emplace_back();
    }
    leaf_[i] = own;
    const auto x = static_cast<std::int32_t>(i) % width_px_, y = static_cast<std::int32_t>(i) / width_px_;
    const Pixel& pixel = pixels[i];
    Region region;
    region.pixels = 1;
    region.color = pixel.color;
    region.box = {x, y, x, y};
    region.rim = x == 0 || y == 0 || x + 1 == width_px_ || y + 1 == height_px_ ? 1 : 0;
    for (int c = 0; c < 3; ++c) region.square[c] = pixel.color[c] * pixel.color[c];
    if (pixel.distance > 0) {
      region.seen = 1;
      region.distance = pixel.distance;
      region.place = pixel.place;
      region.normal = pixel.normal;
    }
    nodes_[static_cast<std::size_t>(own)].region.add(region);
  }
}

std::vector<ThingTree::Pair> ThingTree::find_borders(const std::vector<Pixel>& pixels) {
  std::vector<Pair> pairs;
  CellIndex known;
  const auto look = [&](std::int32_t x, std::int32_t y, std::int32_t dx, std::int32_t dy) {
    const auto at = [&](std::int32_t u, std::int32_t v) {
      return static_cast<std::size_t>(std::int64_t{std::clamp(v, 0, height_px_ - 1)} * width_px_ +
                                      std::clamp(u, 0, width_px_ - 1));
    };
    std::int32_t a = leaf_[at(x, y)], b = leaf_[at(x + dx, y + dy)];
    if (a == b) return;
    if (a > b) std::swap(a, b);
    const auto key = static_cast<std::uint64_t>(a) << 32 | static_cast<std::uint32_t>(b);
    const std::int32_t number = known.add(key, static_cast<std::int32_t>(pairs.size()));
    if (number == std::ssize(pairs)) pairs.push_back({a, b, {}});
    const Pixel& before = pixels[at(x - reach_px_ * dx, y - reach_px_ * dy)];
    const Pixel& behind = pixels[at(x + (1 + reach_px_) * dx, y + (1 + reach_px_) * dy)];
    const double step = steps_of_color(before.color, behind.color);
    double gap = 0;  // of each from the plane of the other
    if (before.distance > 0 && behind.distance > 0) {
      const Vec3d way = behind.place - before.place;
      gap = std::min(std::abs(dot(way, before.normal)), std::abs(dot(way, behind.normal))) /
            std::min(before.distance, behind.distance);
    }
    Border& border = pairs[static_cast<std::size_t>(number)].border;
    border.length += 1;
    border.step += step;
    border.clear += step > kClearColor || gap > kClearGap ? 1 : 0;
    const std::int32_t here = pixels[at(x, y)].segment, there = pixels[at(x + dx, y + dy)].segment;
    border.segments += here != there ? 1 : here != 0 ? -1 : 0;
  };
  for (std::int32_t y = 0; y < height_px_; ++y) {
    for (std::int32_t x = 0; x < width_px_; ++x) {
      if (x + 1 < width_px_) look(x, y, 1, 0);
      if (y + 1 < height_px_) look(x, y, 0, 1);
    }
  }
  return pairs;
}

double ThingTree::cost_of(const Region& a, const Region& b, const Border& border) const {
  const Vec3d mean_a = a.color * (1 / a.pixels), mean_b = b.color * (1 / b.pixels);
  const double color = length(mean_a - mean_b);
  const double texture =
      std::sqrt((spread_of(mean_a, a.square * (1 / a.pixels)) + spread_of(mean_b, b.square * (1 / b.pixels))) / 2);
  double turn = 0, offset = 0;
  const double size_a = length(a.normal), size_b = length(b.normal);
  if (size_a > 0 && size_b > 0) {
    const Vec3d normal_a = a.normal * (1 / size_a), normal_b = b.normal * (1 / size_b);
    const Vec3d way = b.place * (1 / b.seen) - a.place * (1 / a.seen);
    turn = 1 - dot(normal_a, normal_b);
    offset = std::max(std::abs(dot(way, normal_a)), std::abs(dot(way, normal_b))) /
             std::min(a.distance / a.seen, b.distance / b.seen);
  }
  const double smaller = std::min(a.pixels, b.pixels), step = std::min(1.0, border.step / border.length);
  const double most_color = std::min(color, 0.5);
  return kBorderOdds.always + kBorderOdds.color * most_color +
         kBorderOdds.color_by_texture * std::min(4.0, color / (texture + 0.03)) + kBorderOdds.step * step +
         kBorderOdds.turn * turn + kBorderOdds.offset * 3 * std::min(offset, 0.3) +
         kBorderOdds.smaller * (std::log(smaller / static_cast<double>(leaf_.size())) / 5 + 1) +
         kBorderOdds.shared * std::min(2.0, border.length / (4 * std::sqrt(smaller))) +
         kBorderOdds.root_color * std::sqrt(most_color) + kBorderOdds.root_step * std::sqrt(step) +
         kBorderOdds.clear * border.clear / border.length + kSegmentOdds * border.segments / border.length;
}

void ThingTree::join(std::vector<Pair> pairs) {
  struct Touch {
    std::int32_t other, pair;
  };
  using Entry = std::tuple<double, std::int32_t, std::int32_t, std::int32_t>;  // cost, the two, their pair
  std::priority_queue<Entry, std::vector<Entry>, std::greater<>> queue;
  const std::size_t most = 2 * nodes_.size();
  nodes_.reserve(most);
  std::vector<std::vector<Touch>> touching(most);
  std::vector<double> length(most, 0);  // of the outlines
  const auto told = [&](std::int32_t n, double border, double cost) {
    length[static_cast<std::size_t>(n)] += border;
    nodes_[static_cast<std::size_t>(n)].outline += border * std::clamp(cost, -3.0, 4.0);
  };
  const auto offer = [&](std::int32_t a, std::int32_t b, std::int32_t pair) {
    const Border& border = pairs[static_cast<std::size_t>(pair)].border;
    const double cost = cost_of(node(a).region, node(b).region, border);
    queue.emplace(cost, a, b, pair);
    told(a, border.length, cost);
    if (b > a)
      told(b, border.length, cost);  // of the first pairs; a node that comes later is no news for its neighbours
  };
  for (std::size_t p = 0; p < pairs.size(); ++p) {
    const auto number = static_cast<std::int32_t>(p);
    touching[static_cast<std::size_t>(pairs[p].a)].push_back({pairs[p].b, number});
    touching[static_cast<std::size_t>(pairs[p].b)].push_back({pairs[p].a, number});
    offer(pairs[p].a, pairs[p].b, number);
  }
  std::vector<std::int32_t> slot(most, -1);
  while (!queue.empty()) {
    const auto [cost, a, b, pair] = queue.top();
    queue.pop();
    if (node(a).parent >= 0 || node(b).parent >= 0) continue;
    const auto own = static_cast<std::int32_t>(nodes_.size());
    Node joined;
    joined.parts = {a, b};
    joined.cost = cost;
    joined.region = node(a).region;
    joined.region.add(node(b).region);
    for (const std::int32_t part : {a, b}) {
      nodes_[static_cast<std::size_t>(part)].parent = own;
      if (part >= leaves_) joined.cost = std::max(joined.cost, node(part).cost);
    }
    nodes_.push_back(joined);
    std::vector<Touch>& around = touching[static_cast<std::size_t>(own)];
    for (const std::int32_t part : {a, b}) {
      for (const Touch& touch : touching[static_cast<std::size_t>(part)]) {
        if (node(touch.other).parent >= 0) continue;
        std::int32_t& place = slot[static_cast<std::size_t>(touch.other)];
        if (place < 0) {
          place = static_cast<std::int32_t>(around.size());
          around.push_back(touch);
          continue;
        }
        Border& kept = pairs[static_cast<std::size_t>(around[static_cast<std::size_t>(place)].pair)].border;
        kept.add(pairs[static_cast<std::size_t>(touch.pair)].border);
      }
      touching[static_cast<std::size_t>(part)] = {};
    }
    for (const Touch& touch : around) {
      slot[static_cast<std::size_t>(touch.other)] = -1;
      std::vector<Touch>& back = touching[static_cast<std::size_t>(touch.other)];
      std::erase_if(back, [&](const Touch& t) { return node(t.other).parent >= 0; });
      back.push_back({own, touch.pair});
      offer(own, touch.other, touch.pair);
    }
  }
  for (std::size_t n = 0; n < nodes_.size(); ++n)
    if (length[n] > 0) nodes_[n].outline /= length[n];
}

void ThingTree::order_leaves() {
  std::int32_t next = 0;
  std::vector<std::int32_t> stack;
  // A picture is connected, so the last node holds all of it.
  stack.push_back(static_cast<std::int32_t>(nodes_.size()) - 1);
  while (!stack.empty()) {
    Node& at = nodes_[static_cast<std::size_t>(stack.back())];
    stack.pop_back();
    at.first_leaf = next;
    if (at.parts[0] < 0) at.last_leaf = ++next;
    for (const std::int32_t part : at.parts)
      if (part >= 0) stack.push_back(part);
  }
  for (std::size_t n = static_cast<std::size_t>(leaves_); n < nodes_.size(); ++n)
    nodes_[n].last_leaf = std::max(node(nodes_[n].parts[0]).last_leaf, node(nodes_[n].parts[1]).last_leaf);
}

ThingTree::ThingTree(const ThingPicture& picture)
    : width_px_(picture.width_px), height_px_(picture.height_px), reach_px_(picture.width_px >= kSharpWidth ? 2 : 1) {
  leaf_.resize(static_cast<std::size_t>(std::int64_t{width_px_} * height_px_));
  SEMFIELD_CHECK(!leaf_.empty() && picture.rgb.size() == 3 * leaf_.size(), "a picture's colours match its size");
  SEMFIELD_CHECK(picture.segment.empty() || picture.segment.size() == leaf_.size(), "segments match its size");
  const std::vector<Pixel> pixels = pixels_of(picture);
  find_regions(pixels);
  join(find_borders(pixels));
  order_leaves();
}

// How far it is from a place to the outline at least, as a share of the root of the node's pixels: people click into
// the middle of what they mean.
double ThingTree::inside(std::int32_t n, const PixelPlace& at) const {
  double least = std::hypot(width_px_, height_px_);
  for (int ray = 0; ray < kRays; ++ray) {
    const double angle = 2 * std::numbers::pi * ray / kRays, dx = std::cos(angle), dy = std::sin(angle);
    double way = 0;
    while (way < least) {
      way += 1;
      const auto x = static_cast<std::int32_t>(at.column + dx * way), y = static_cast<std::int32_t>(at.row + dy * way);
      if (x < 0 || y < 0 || x >= width_px_ || y >= height_px_ || !holds(n, leaf_at({x, y}))) break;
    }
    least = std::min(least, way);
  }
  return least / std::sqrt(node(n).region.pixels);
}

double ThingTree::likelihood(std::int32_t n, const PixelPlace& at) const {
  const Region& region = node(n).region;
  const double own = n < leaves_ ? -3 : std::clamp(node(n).cost, kLowest, kHighest);
  const double up = node(n).parent < 0 ? kHighest : std::clamp(node(node(n).parent).cost, kLowest, kHighest);
  const double share = region.pixels / static_cast<double>(leaf_.size());
  const double box = static_cast<double>(region.box[2] - region.box[0] + 1) * (region.box[3] - region.box[1] + 1);
  // How much larger what it belongs to is, where a little more is joined.
  std::int32_t above = n;
  while (node(above).parent >= 0 && node(node(above).parent).cost < own + 1) above = node(above).parent;
  return kThingOdds.jump * std::clamp(up - own, 0.0, 4.0) + kThingOdds.share * std::log(share) / 3 +
         kThingOdds.rim * region.rim / (2.0 * (width_px_ + height_px_)) + kThingOdds.filled * region.pixels / box +
         kThingOdds.outline * node(n).outline + kThingOdds.stays * std::log(node(above).region.pixels / region.pixels) +
         kThingOdds.inside * inside(n, at);
}

// Nodes over `leaf`, of which each is clearly larger than the one before; `n` is among them.
std::vector<std::int32_t> ThingTree::levels_of(std::int32_t n, std::int32_t leaf) const {
  std::vector<std::int32_t> below;  // from the leaf up to `n`
  for (std::int32_t at = leaf; at != n; at = node(at).parent) below.push_back(at);
  std::vector<std::int32_t> levels{n};
  for (auto at = below.rbegin(); at != below.rend(); ++at)
    if (node(*at).region.pixels * kLevelStep <= node(levels.back()).region.pixels) levels.push_back(*at);
  std::reverse(levels.begin(), levels.end());
  for (std::int32_t at = node(n).parent; at >= 0; at = node(at).parent)
    if (node(at).region.pixels >= kLevelStep * node(levels.back()).region.pixels) levels.push_back(at);
  return levels;
}

Thing ThingTree::choose(std::span<const PixelPlace> also, std::span<const PixelPlace> without, int level) const {
  SEMFIELD_CHECK(!also.empty(), "a thing is somewhere");
  const double least = static_cast<double>(leaf_.size()) / kLeastThing;
  std::vector<char> taken(static_cast<std::size_t>(leaves_), 0);  // in the order of the tree
  const auto order = [&](const PixelPlace& at) { return static_cast<std::size_t>(node(leaf_at(at)).first_leaf); };
  std::vector<double> pixels(static_cast<std::size_t>(leaves_));
  for (std::int32_t leaf = 0; leaf < leaves_; ++leaf)
    pixels[static_cast<std::size_t>(node(leaf).first_leaf)] = node(leaf).region.pixels;
  const auto taken_of = [&](std::int32_t n) {
    double sum = 0;
    for (std::int32_t k = node(n).first_leaf; k < node(n).last_leaf; ++k)
      if (taken[static_cast<std::size_t>(k)] != 0) sum += pixels[static_cast<std::size_t>(k)];
    return sum / node(n).region.pixels;
  };
  // The likeliest node over a place of those that may be.
  const auto likeliest = [&](const PixelPlace& at, const auto& may_be) {
    std::int32_t best = leaf_at(at);
    double most = -INFINITY;
    for (std::int32_t n = best; n >= 0 && may_be(n); n = node(n).parent) {
      if (node(n).region.pixels < least && node(n).parent >= 0) continue;
      const double found = likelihood(n, at);
      if (found <= most) continue;
      most = found;
      best = n;
    }
    return best;
  };
  const auto take = [&](std::int32_t n, char is_in) {
    std::fill(taken.begin() + node(n).first_leaf, taken.begin() + node(n).last_leaf, is_in);
  };
  Thing thing;
  const std::int32_t likely = likeliest(also[0], [](std::int32_t) { return true; });
  const std::vector<std::int32_t> levels = levels_of(likely, leaf_at(also[0]));
  const auto zero = static_cast<int>(std::find(levels.begin(), levels.end(), likely) - levels.begin());
  thing.least = -zero;
  thing.most = static_cast<int>(levels.size()) - 1 - zero;
  thing.level = std::clamp(level, thing.least, thing.most);
  take(levels[static_cast<std::size_t>(zero + thing.level)], 1);
  for (const PixelPlace& at : also.subspan(1))
    if (taken[order(at)] == 0) take(likeliest(at, [&](std::int32_t n) { return taken_of(n) <= 0.1; }), 1);
  for (const PixelPlace& at : without) {
    if (taken[order(at)] == 0) continue;
    take(likeliest(at,
                   [&](std::int32_t n) {
                     const bool is_named =
                         std::any_of(also.begin(), also.end(), [&](const auto& p) { return holds(n, leaf_at(p)); });
                     return !is_named && taken_of(n) >= 0.5;
                   }),
         0);
  }
  for (const PixelPlace& at : also) taken[order(at)] = 1;
  for (const PixelPlace& at : without) taken[order(at)] = 0;
  thing.mask.resize(leaf_.size());
  double sum = 0;
  for (std::size_t i = 0; i < leaf_.size(); ++i) {
    thing.mask[i] = taken[static_cast<std::size_t>(node(leaf_[i]).first_leaf)] != 0;
    sum += thing.mask[i] ? 1 : 0;
  }
  thing.share = sum / static_cast<double>(leaf_.size());
  return thing;
}

}  // namespace semfield
