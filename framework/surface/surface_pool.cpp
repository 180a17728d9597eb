#include "surface/surface_pool.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "compute/parallel.h"

namespace semfield {

namespace {

SeenSurface seen_by(const PoolView& view, const RayLimits& limits) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  const SurfaceMap& map = view.map;
  std::vector<Vec3d> places(map.distance_m.size(), Vec3d{kNone, kNone, kNone});
  for (std::size_t i = 0; i < places.size(); ++i) {
    const auto distance = static_cast<double>(map.distance_m[i]);
    if (!(distance > 0)) continue;
    places[i] =
        point_at(view.camera, limits, strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride), distance);
  }
  return seen_surface(std::move(places), map.width_px, view.camera.world_from_camera.t);
}

double extent_of(std::span<const SeenSurface> seen) {
  Vec3d low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};
  for (const SeenSurface& view : seen) {
    for (const Vec3d& place : view.place) {
      if (!is_place(place)) continue;
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], place[axis]);
        high[axis] = std::max(high[axis], place[axis]);
      }
    }
  }
  return low.x > high.x ? 0 : length(high - low);
}

}  // namespace

PointDifference difference(const PoolPoint& a, const PoolPoint& b, double color_sigma, double normal_sigma) {
  const Vec3d dc = a.color - b.color, dn = a.normal - b.normal;
  return {dot(dc, dc) * (1 / (2 * color_sigma * color_sigma)), dot(dn, dn) * (1 / (2 * normal_sigma * normal_sigma))};
}

void SurfacePool::number(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
  std::vector<std::int32_t>& of_pixel = point_of_pixel[view];
  of_pixel.assign(seen.place.size(), -1);
  for (std::size_t i = 0; i < of_pixel.size(); ++i) {
    const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), seen.width_px, stride);
    const auto at = static_cast<std::size_t>(std::int64_t{pixel.row} * photo.width_px + pixel.column);
    if (photo.mask.uses(at)) of_pixel[i] = cells.add(seen.place[i]);
  }
}

void SurfacePool::gather(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
  points.resize(static_cast<std::size_t>(cells.count()));
  const std::vector<std::int32_t>& of_pixel = point_of_pixel[view];
  for (std::size_t i = 0; i < of_pixel.size(); ++i) {
    if (of_pixel[i] < 0) continue;
    const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), seen.width_px, stride);
    const auto at = static_cast<std::size_t>(std::int64_t{pixel.row} * photo.width_px + pixel.column);
    PoolPoint& point = points[static_cast<std::size_t>(of_pixel[i])];
    const std::uint8_t* const rgb = &photo.rgb[3 * at];
    point.color = point.color + Vec3d{double(rgb[0]), double(rgb[1]), double(rgb[2])};
    point.position = point.position + seen.place[i];
    point.normal = point.normal + seen.normal[i];
    point.pixels += 1;
    const bool interior = seen.is_interior(static_cast<std::int64_t>(i)), first = point.pixels == 1;
    if (!first && (interior != point.interior ? !interior : seen.distance_m[i] >= point.distance_m)) continue;
    point.distance_m = seen.distance_m[i];
    point.interior = interior;
    point.view = static_cast<int>(view);
    point.pixel = pixel;
  }
}

void SurfacePool::finish() {
  for (PoolPoint& point : points) {
    point.position = point.position * (1 / point.pixels);
    point.color = point.color * (1 / (255 * point.pixels));
    const double size = length(point.normal);
    point.normal = size > 0 ? point.normal * (1 / size) : Vec3d{};
  }
}

SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted) {
  std::vector<SeenSurface> seen(views.size());
  parallel_for(std::ssize(views), [&](std::int64_t v) {
    const PoolView& view = views[static_cast<std::size_t>(v)];
    if (!view.map.empty()) seen[static_cast<std::size_t>(v)] = seen_by(view, limits);
  });
  const double extent = extent_of(seen);
  SurfacePool pool;
  pool.point_of_pixel.resize(views.size());
  for (std::size_t v = 0; v < views.size(); ++v) pool.point_of_pixel[v].assign(seen[v].place.size(), -1);
  if (!(extent > 0)) return pool;
  // A surface has as many cells as the square of their number per axis; the second turn corrects the first guess.
  double cell_m = extent / std::sqrt(static_cast<double>(wanted));
  for (int turn = 0; turn < 3; ++turn) {
    pool = SurfacePool(cell_m, views.size());
    for (std::size_t v = 0; v < views.size(); ++v)
      if (!views[v].map.empty()) pool.number(v, seen[v], *views[v].photo, views[v].map.stride);
    const double ratio = static_cast<double>(pool.cells.count()) / static_cast<double>(wanted);
    if (ratio > 0.8 && ratio < 1.25) break;
    cell_m *= std::clamp(std::sqrt(ratio), 0.2, 5.0);
  }
  for (std::size_t v = 0; v < views.size(); ++v)
    if (!views[v].map.empty()) pool.gather(v, seen[v], *views[v].photo, views[v].map.stride);
  pool.finish();
  return pool;
}

}  // namespace semfield
