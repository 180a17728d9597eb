#include "surface/seen_surface.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr double kDepthStep = 0.05;  // of the distance: neighbours that differ more lie on two surfaces
// Cosine between the ray through an image point and the one that should fall there: equal but for rounding.
constexpr double kSameRay = 1 - 1e-9;

// The neighbour at `index` +- `step` that is a place and nearer to the one at `index`; the way to it, towards growing
// indices. Zero without such a neighbour.
Vec3d way_along(std::span<const Vec3d> places, std::size_t index, std::size_t step, bool has_before, bool has_after) {
  Vec3d best;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](std::size_t other, double sign) {
    const Vec3d way = (places[other] - places[index]) * sign;
    if (!is_place(places[other]) || !(length(way) < least)) return;
    least = length(way);
    best = way;
  };
  if (has_before) consider(index - step, -1);
  if (has_after) consider(index + step, 1);
  return best;
}

}  // namespace

std::optional<Vec3d> surface_point(const PosedDepth& view, std::int32_t column, std::int32_t row) {
  const float z = view.depth_m[view.pixel(column, row)];
  if (!(z > 0 && std::isfinite(z))) return std::nullopt;
  const Vec3d direction = view.camera.direction(column + 0.5, row + 0.5);
  const double share = view.camera.depth_of(direction);
  if (!(share > 0)) return std::nullopt;
  return view.world_from_camera.apply(direction * (static_cast<double>(z) / share));
}

std::optional<PixelHit> project_point(const Camera& camera, const Pose& world_from_camera, Vec3d point) {
  const Vec3d local = world_from_camera.apply_inverse(point);
  if (!camera.sees(local)) return std::nullopt;
  double u = 0, v = 0;
  camera.project(local, u, v);
  // Written so that NaN is outside; whole numbers are taken only of what fits.
  if (!(u >= 0 && u < camera.width_px && v >= 0 && v < camera.height_px)) return std::nullopt;
  if (camera.has_distortion() && !(dot(camera.direction(u, v), normalized(local)) > kSameRay)) return std::nullopt;
  return PixelHit{static_cast<std::int32_t>(u), static_cast<std::int32_t>(v), camera.depth_of(local), u, v};
}

bool is_place(Vec3d point) { return std::isfinite(point.x) && std::isfinite(point.y) && std::isfinite(point.z); }

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

bool SeenSurface::is_interior(std::int64_t pixel) const {
  const std::int64_t x = pixel % width_px, y = pixel / width_px;
  if (x == 0 || y == 0 || x + 1 == width_px || y + 1 == height_px) return false;
  const auto at = [&](std::int64_t p) { return distance_m[static_cast<std::size_t>(p)]; };
  const double here = at(pixel), left = at(pixel - 1), right = at(pixel + 1), above = at(pixel - width_px),
               below = at(pixel + width_px);
  if (!(here > 0 && left > 0 && right > 0 && above > 0 && below > 0)) return false;
  // A plane seen at a slant has steps that are alike on both sides; a border has one on one side.
  return std::max(std::abs(left + right - 2 * here), std::abs(above + below - 2 * here)) < kDepthStep * here;
}

SeenSurface seen_surface(std::vector<Vec3d> place, std::int32_t width_px, Vec3d eye) {
  SeenSurface seen;
  seen.width_px = width_px;
  seen.height_px = static_cast<std::int32_t>(std::ssize(place) / width_px);
  seen.place = std::move(place);
  seen.normal.resize(seen.place.size());
  seen.distance_m.resize(seen.place.size());
  const auto width = static_cast<std::size_t>(width_px), height = static_cast<std::size_t>(seen.height_px);
  parallel_for(seen.height_px, [&](std::int64_t y) {
    const auto row = static_cast<std::size_t>(y);
    for (std::size_t column = 0; column < width; ++column) {
      const std::size_t pixel = row * width + column;
      const Vec3d own = seen.place[pixel];
      if (!is_place(own)) continue;
      seen.distance_m[pixel] = length(own - eye);
      const Vec3d along = way_along(seen.place, pixel, 1, column > 0, column + 1 < width);
      const Vec3d down = way_along(seen.place, pixel, width, row > 0, row + 1 < height);
      const Vec3d normal = cross(along, down);
      const double size = length(normal);
      if (!(size > 0)) continue;
      seen.normal[pixel] = normal * (1 / size);
      if (dot(seen.normal[pixel], eye - own) < 0) seen.normal[pixel] = seen.normal[pixel] * -1.0;
    }
  });
  return seen;
}

}  // namespace semfield
