#include "serve/named_places.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <unordered_set>

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr double kAlikeColor = 24;        // of 255, a channel
constexpr double kAlikeDistance = 0.03;   // of the distance
constexpr std::size_t kMostPixels = 256;  // of a stroke

double spent_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

std::uint64_t key_of(const LabelledPixels& click) {
  std::uint64_t hash = 0xcbf29ce484222325ull;
  const auto mix = [&](std::uint64_t value) {
    hash = (hash ^ value) * 0x100000001B3ull;
    hash ^= hash >> 29;
  };
  mix(static_cast<std::uint64_t>(click.view));
  for (const PixelPlace& p : click.pixels)
    mix(static_cast<std::uint64_t>(p.row) << 32 | static_cast<std::uint32_t>(p.column));
  return hash;
}

// The first pixel of a stroke on each cell of the pool; where the view's map meets nothing, on each pixel of the map.
std::vector<PixelPlace> one_a_cell(const LabelledPixels& stroke, const NamedPlaces::Surface& surface) {
  const auto v = static_cast<std::size_t>(stroke.view);
  const SurfaceMap& map = surface.views[v].map;
  std::vector<PixelPlace> some;
  std::unordered_set<std::int64_t> taken;
  for (const PixelPlace& pixel : stroke.pixels) {
    if (!map.empty()) {
      const std::int64_t x = std::clamp(pixel.column / map.stride, 0, map.width_px - 1),
                         y = std::clamp(pixel.row / map.stride, 0, map.height_px - 1), at = y * map.width_px + x;
      const bool pooled = v < surface.pool.point_of_pixel.size() && !surface.pool.point_of_pixel[v].empty();
      const std::int32_t point = pooled ? surface.pool.point_of_pixel[v][static_cast<std::size_t>(at)] : -1;
      if (!taken.insert(point >= 0 ? point : -1 - at).second) continue;
    }
    some.push_back(pixel);
  }
  if (some.size() <= kMostPixels) return some;
  std::vector<PixelPlace> fewer;
  for (std::size_t i = 0; i < kMostPixels; ++i) fewer.push_back(some[i * some.size() / kMostPixels]);
  return fewer;
}

}  // namespace

std::vector<PixelPlace> NamedPlaces::pixels_of(const LabelledPixels& click, const Surface& surface) const {
  if (is_stroke(click)) return one_a_cell(click, surface);
  if (reach_px_ == 0) return click.pixels;
  const StoredFrame& photo = *surface.views[static_cast<std::size_t>(click.view)].photo;
  std::vector<PixelPlace> all = click.pixels;
  const PixelPlace center = click.pixels.front();
  const std::int32_t reach = std::max(1, reach_px_ * photo.width_px / 320);
  const auto at = [&](std::int32_t x, std::int32_t y) {
    return 3 * static_cast<std::size_t>(std::int64_t{y} * photo.width_px + x);
  };
  const std::size_t own = at(center.column, center.row);
  for (std::int32_t y = center.row - reach; y <= center.row + reach; ++y) {
    for (std::int32_t x = center.column - reach; x <= center.column + reach; ++x) {
      const std::int32_t dx = x - center.column, dy = y - center.row;
      if (x < 0 || y < 0 || x >= photo.width_px || y >= photo.height_px || dx * dx + dy * dy > reach * reach) continue;
      if (dx == 0 && dy == 0) continue;
      bool alike = true;
      for (std::size_t c = 0; c < 3; ++c)
        alike = alike && std::abs(int{photo.rgb[at(x, y) + c]} - int{photo.rgb[own + c]}) <= kAlikeColor;
      if (alike) all.push_back({x, y});
    }
  }
  return all;
}

void NamedPlaces::look_for(Known& known, const LabelledPixels& click, const Surface& surface) {
  const RayCamera& camera = surface.views[static_cast<std::size_t>(click.view)].camera;
  const std::vector<PixelPlace> pixels = pixels_of(click, surface);
  const std::vector<float> distance = surface_distances(surface.pipeline, camera, surface.limits, pixels);
  ++found_;
  known.age = age_;
  known.places.clear();
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    const bool own = is_stroke(click) || i < click.pixels.size();
    if (!(distance[i] > 0)) continue;
    if (!own && !(std::abs(distance[i] - distance[0]) < kAlikeDistance * distance[0])) continue;
    known.places.push_back(point_at(camera, surface.limits, pixels[i], static_cast<double>(distance[i])));
  }
}

bool NamedPlaces::find(std::span<const LabelledPixels> clicks, const Surface& surface, double budget_s) {
  const Clock::time_point start = Clock::now();
  ++turn_;
  keys_.clear();
  bool all = true, first = true;
  for (const LabelledPixels& click : clicks) {
    keys_.push_back(key_of(click));
    Known& known = known_[keys_.back()];
    known.turn = turn_;
    if (known.age > 0) continue;
    if (!first && spent_since(start) >= budget_s) {
      all = false;
      continue;
    }
    first = false;
    look_for(known, click, surface);
  }
  std::erase_if(known_, [&](const auto& entry) { return entry.second.turn != turn_; });
  return all;
}

void NamedPlaces::refresh(std::span<const LabelledPixels> clicks, const Surface& surface, double budget_s) {
  const Clock::time_point start = Clock::now();
  for (std::size_t i = 0; i < keys_.size() && spent_since(start) < budget_s; ++i) {
    Known& known = known_.at(keys_[i]);
    if (known.age == 0 || known.age == age_) continue;
    look_for(known, clicks[i], surface);
  }
}

std::span<const Vec3d> NamedPlaces::of(std::size_t i) const { return known_.at(keys_.at(i)).places; }

}  // namespace semfield
