#include "fuse/surface_cells.h"

#include <cmath>
#include <limits>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

constexpr std::int32_t kFarthest = 1 << 20;  // cells from the origin along an axis; 21 bits of a key

// The neighbour at `index` +- `step` that is a point and nearer to the one at `index`; the way to it, towards growing
// indices. Zero without such a neighbour.
Vec3d way_along(std::span<const Vec3d> points, std::size_t index, std::size_t step, bool has_before, bool has_after) {
  Vec3d best;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](std::size_t other, double sign) {
    const Vec3d way = (points[other] - points[index]) * sign;
    if (!is_point(points[other]) || !(length(way) < least)) return;
    least = length(way);
    best = way;
  };
  if (has_before) consider(index - step, -1);
  if (has_after) consider(index + step, 1);
  return best;
}

}  // namespace

SurfaceCells::SurfaceCells(double edge_m) : edge_m_(edge_m) {
  SEMFIELD_CHECK(edge_m > 0 && std::isfinite(edge_m), "a cell's edge is a positive length");
}

std::uint64_t SurfaceCells::key_of(const Place& place) {
  std::uint64_t key = 0;
  for (const std::int32_t coordinate : place) key = key << 21 | static_cast<std::uint64_t>(coordinate + kFarthest);
  return key;
}

std::int32_t SurfaceCells::add(Vec3d point) {
  Place place{};
  for (int axis = 0; axis < 3; ++axis) {
    const double at = std::floor((axis == 0 ? point.x : axis == 1 ? point.y : point.z) / edge_m_);
    if (!(std::abs(at) < kFarthest - 1)) return -1;  // NaN too
    place[static_cast<std::size_t>(axis)] = static_cast<std::int32_t>(at);
  }
  const auto [found, fresh] = index_.try_emplace(key_of(place), count());
  if (fresh) places_.push_back(place);
  return found->second;
}

std::vector<CellPair> SurfaceCells::neighbours() const {
  std::vector<CellPair> pairs;
  for (std::int32_t cell = 0; cell < count(); ++cell) {
    const Place& place = places_[static_cast<std::size_t>(cell)];
    for (int offset = 14; offset < 27; ++offset) {  // the half of the 27 behind the cell itself
      const Place other{place[0] + offset / 9 - 1, place[1] + offset / 3 % 3 - 1, place[2] + offset % 3 - 1};
      const auto found = index_.find(key_of(other));
      if (found != index_.end()) pairs.push_back({cell, found->second});
    }
  }
  return pairs;
}

bool is_point(Vec3d point) { return std::isfinite(point.x) && std::isfinite(point.y) && std::isfinite(point.z); }

std::vector<Vec3d> surface_points(const PosedDepth& view) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  std::vector<Vec3d> points(view.depth_m.size(), Vec3d{kNone, kNone, kNone});
  parallel_for(view.camera.height_px, [&](std::int64_t row) {
    for (std::int32_t column = 0; column < view.camera.width_px; ++column) {
      const auto point = surface_point(view, column, static_cast<std::int32_t>(row));
      if (point) points[view.pixel(column, static_cast<std::int32_t>(row))] = *point;
    }
  });
  return points;
}

std::vector<Vec3d> surface_normals(const PosedDepth& view, std::span<const Vec3d> points) {
  std::vector<Vec3d> normals(points.size());
  const std::int32_t width = view.camera.width_px, height = view.camera.height_px;
  parallel_for(height, [&](std::int64_t row) {
    for (std::int32_t column = 0; column < width; ++column) {
      const std::size_t pixel = view.pixel(column, static_cast<std::int32_t>(row));
      if (!is_point(points[pixel])) continue;
      const Vec3d along = way_along(points, pixel, 1, column > 0, column + 1 < width);
      const Vec3d down = way_along(points, pixel, static_cast<std::size_t>(width), row > 0,
                                   row + 1 < static_cast<std::int64_t>(height));
      Vec3d normal = cross(along, down);
      const double size = length(normal);
      if (!(size > 0)) continue;
      normal = normal * (1 / size);
      const bool away = dot(normal, view.world_from_camera.t - points[pixel]) < 0;
      normals[pixel] = away ? normal * -1.0 : normal;
    }
  });
  return normals;
}

}  // namespace semfield
