#include "serve/surface_pool.h"

#include <algorithm>
#include <cmath>
#include <unordered_map>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr double kDepthStep = 0.05;           // of the distance: neighbours that differ more lie on two surfaces
constexpr std::int64_t kCellRange = 1 << 20;  // cells an axis that a key tells apart

struct Seen {
  Vec3d position;
  double distance = 0;
  bool interior = false;
};

std::uint64_t key_of(Vec3d p, double cell) {
  std::uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const auto index = static_cast<std::int64_t>(std::floor(p[axis] / cell));
    key = key << 21 | static_cast<std::uint64_t>(std::clamp(index, -kCellRange, kCellRange - 1) + kCellRange);
  }
  return key;
}

std::vector<Seen> seen_by(const PoolView& view, const RayLimits& limits) {
  const SurfaceMap& map = view.map;
  std::vector<Seen> seen(map.distance_m.size());
  const auto distance = [&](std::int32_t x, std::int32_t y) {
    return static_cast<double>(map.distance_m[static_cast<std::size_t>(std::int64_t{y} * map.width_px + x)]);
  };
  for (std::int32_t y = 0; y < map.height_px; ++y) {
    for (std::int32_t x = 0; x < map.width_px; ++x) {
      const double here = distance(x, y);
      if (!(here > 0)) continue;
      const std::int64_t i = std::int64_t{y} * map.width_px + x;
      Seen& point = seen[static_cast<std::size_t>(i)];
      point.distance = here;
      point.position = point_at(view.camera, limits, strided_place(i, map.width_px, map.stride), here);
      point.interior = x > 0 && y > 0 && x + 1 < map.width_px && y + 1 < map.height_px;
      if (!point.interior) continue;
      // A plane seen at a slant has steps that are alike on both sides; a border has one on one side.
      const double bend_x = std::abs(distance(x - 1, y) + distance(x + 1, y) - 2 * here),
                   bend_y = std::abs(distance(x, y - 1) + distance(x, y + 1) - 2 * here);
      point.interior = std::max(bend_x, bend_y) < kDepthStep * here && distance(x - 1, y) > 0 &&
                       distance(x + 1, y) > 0 && distance(x, y - 1) > 0 && distance(x, y + 1) > 0;
    }
  }
  return seen;
}

double extent_of(const std::vector<std::vector<Seen>>& seen) {
  Vec3d low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};
  for (const std::vector<Seen>& view : seen) {
    for (const Seen& point : view) {
      if (!(point.distance > 0)) continue;
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], point.position[axis]);
        high[axis] = std::max(high[axis], point.position[axis]);
      }
    }
  }
  return low.x > high.x ? 0 : length(high - low);
}

}  // namespace

SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted) {
  std::vector<std::vector<Seen>> seen(views.size());
  parallel_for(std::ssize(views), [&](std::int64_t v) {
    const PoolView& view = views[static_cast<std::size_t>(v)];
    if (!view.map.empty()) seen[static_cast<std::size_t>(v)] = seen_by(view, limits);
  });
  SurfacePool pool;
  const double extent = extent_of(seen);
  pool.point_of_pixel.resize(views.size());
  for (std::size_t v = 0; v < views.size(); ++v) pool.point_of_pixel[v].assign(seen[v].size(), -1);
  if (!(extent > 0)) return pool;
  // A surface has as many cells as the square of their number an axis; the second turn corrects the first guess.
  pool.cell_m = extent / std::sqrt(static_cast<double>(wanted));
  for (int turn = 0; turn < 3; ++turn) {
    std::unordered_map<std::uint64_t, std::int32_t> number;
    pool.points.clear();
    std::vector<double> distance;
    for (std::size_t v = 0; v < views.size(); ++v) {
      for (std::size_t i = 0; i < seen[v].size(); ++i) {
        const Seen& candidate = seen[v][i];
        if (!(candidate.distance > 0)) continue;
        const auto [found, fresh] =
            number.emplace(key_of(candidate.position, pool.cell_m), static_cast<std::int32_t>(pool.points.size()));
        const auto at = static_cast<std::size_t>(found->second);
        pool.point_of_pixel[v][i] = found->second;
        if (fresh) {
          pool.points.emplace_back();
          distance.push_back(INFINITY);
        }
        PoolPoint& point = pool.points[at];
        const bool better =
            candidate.interior != point.interior ? candidate.interior : candidate.distance < distance[at];
        if (!fresh && !better) continue;
        distance[at] = candidate.distance;
        const SurfaceMap& map = views[v].map;
        point = {candidate.position,
                 static_cast<int>(v),
                 strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride),
                 candidate.interior,
                 {}};
      }
    }
    const double ratio = static_cast<double>(pool.points.size()) / static_cast<double>(wanted);
    if (turn == 2 || (ratio > 0.8 && ratio < 1.25)) break;
    pool.cell_m *= std::clamp(std::sqrt(ratio), 0.2, 5.0);
  }
  for (PoolPoint& point : pool.points) {
    const StoredFrame* photo = views[static_cast<std::size_t>(point.view)].photo;
    const std::size_t at =
        3 * static_cast<std::size_t>(std::int64_t{point.pixel.row} * photo->width_px + point.pixel.column);
    for (std::size_t c = 0; c < 3; ++c) point.color[c] = static_cast<float>(photo->rgb[at + c]) / 255.0F;
  }
  return pool;
}

}  // namespace semfield
