#include "serve/surface/surface_pool.h"

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
  Vec3d normal;
  double distance = 0;
  bool interior = false;
};

// Across the smaller step of depth on either axis, so that borders do not turn them.
void add_normals(const PoolView& view, std::vector<Seen>& seen) {
  const std::int32_t width = view.map.width_px, height = view.map.height_px;
  const auto at = [&](std::int32_t x, std::int32_t y) -> const Seen& {
    return seen[static_cast<std::size_t>(std::int64_t{y} * width + x)];
  };
  for (std::int32_t y = 0; y < height; ++y) {
    for (std::int32_t x = 0; x < width; ++x) {
      Seen& own = seen[static_cast<std::size_t>(std::int64_t{y} * width + x)];
      if (!(own.distance > 0)) continue;
      Vec3d way[2];
      bool found = true;
      for (int axis = 0; axis < 2 && found; ++axis) {
        double best = INFINITY;
        for (const int side : {-1, 1}) {
          const std::int32_t nx = x + (axis == 0 ? side : 0), ny = y + (axis == 1 ? side : 0);
          if (nx < 0 || ny < 0 || nx >= width || ny >= height || !(at(nx, ny).distance > 0)) continue;
          const double step = std::abs(at(nx, ny).distance - own.distance);
          if (step >= best) continue;
          best = step;
          way[axis] = (at(nx, ny).position - own.position) * side;
        }
        found = std::isfinite(best);
      }
      const Vec3d up = cross(way[0], way[1]);
      const double size = length(up);
      if (!found || !(size > 0)) continue;
      const Vec3d to_camera = view.camera.world_from_camera.t - own.position;
      own.normal = up * ((dot(up, to_camera) < 0 ? -1 : 1) / size);
    }
  }
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
  add_normals(view, seen);
  return seen;
}

struct Best {
  double distance = INFINITY, count = 0;
};

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

SurfaceCell surface_cell(Vec3d p, double edge) {
  SurfaceCell cell{};
  for (int axis = 0; axis < 3; ++axis) {
    const double index = std::clamp(std::floor(p[axis] / edge), -static_cast<double>(kCellRange - 1),
                                    static_cast<double>(kCellRange - 2));
    cell[static_cast<std::size_t>(axis)] = static_cast<std::int32_t>(index);
  }
  return cell;
}

std::uint64_t surface_cell_key(const SurfaceCell& cell) {
  std::uint64_t key = 0;
  for (const std::int32_t index : cell) key = key << 21 | static_cast<std::uint64_t>(index + kCellRange);
  return key;
}

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
    std::vector<Best> best;
    for (std::size_t v = 0; v < views.size(); ++v) {
      const SurfaceMap& map = views[v].map;
      const StoredFrame& photo = *views[v].photo;
      for (std::size_t i = 0; i < seen[v].size(); ++i) {
        const Seen& found = seen[v][i];
        if (!(found.distance > 0)) continue;
        const SurfaceCell cell = surface_cell(found.position, pool.cell_m);
        const auto [entry, fresh] =
            number.emplace(surface_cell_key(cell), static_cast<std::int32_t>(pool.points.size()));
        const auto at = static_cast<std::size_t>(entry->second);
        pool.point_of_pixel[v][i] = entry->second;
        if (fresh) {
          pool.points.emplace_back().cell = cell;
          best.emplace_back();
        }
        PoolPoint& point = pool.points[at];
        Best& known = best[at];
        const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride);
        const std::size_t rgb = 3 * static_cast<std::size_t>(std::int64_t{pixel.row} * photo.width_px + pixel.column);
        for (std::size_t c = 0; c < 3; ++c) point.color[c] += static_cast<float>(photo.rgb[rgb + c]) / 255.0F;
        point.position = point.position + found.position;
        point.normal = point.normal + found.normal;
        known.count += 1;
        if (found.interior != point.interior ? !found.interior : found.distance >= known.distance) continue;
        known.distance = found.distance;
        point.interior = found.interior;
        point.view = static_cast<int>(v);
        point.pixel = pixel;
      }
    }
    for (std::size_t i = 0; i < best.size(); ++i) {
      PoolPoint& point = pool.points[i];
      point.position = point.position * (1 / best[i].count);
      for (float& c : point.color) c /= static_cast<float>(best[i].count);
      const double size = length(point.normal);
      point.normal = size > 0 ? point.normal * (1 / size) : Vec3d{};
    }
    const double ratio = static_cast<double>(pool.points.size()) / static_cast<double>(wanted);
    if (turn == 2 || (ratio > 0.8 && ratio < 1.25)) break;
    pool.cell_m *= std::clamp(std::sqrt(ratio), 0.2, 5.0);
  }
  return pool;
}

}  // namespace semfield
