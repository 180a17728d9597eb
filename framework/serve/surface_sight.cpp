#include "serve/surface_sight.h"

#include <algorithm>
#include <cmath>
#include <unordered_map>

namespace semfield {

namespace {

constexpr double kSameDistance = 0.03;      // of the distance
constexpr std::size_t kMarkPlaces = 8;      // of a stroke or an outline
constexpr std::size_t kMostSeen = 1000;     // clicks of other views in one picture
constexpr std::int32_t kSpotMargin_px = 2;  // a place at the border of a photograph is clicked badly

PixelPlace pixel_at(const Camera& camera, PixelPoint p) {
  return {std::clamp(static_cast<std::int32_t>(p.x), 0, camera.width_px - 1),
          std::clamp(static_cast<std::int32_t>(p.y), 0, camera.height_px - 1)};
}

std::vector<PixelPlace> some_pixels(const std::vector<PixelPoint>& points) {
  std::vector<PixelPlace> out;
  const std::size_t count = std::min(points.size(), kMarkPlaces);
  for (std::size_t i = 0; i < count; ++i) {
    const PixelPoint& p = points[i * points.size() / count];
    out.push_back({static_cast<std::int32_t>(p.x), static_cast<std::int32_t>(p.y)});
  }
  return out;
}

}  // namespace

std::optional<PixelPoint> pixel_of(const RayCamera& camera, Vec3d place) {
  const std::optional<PixelHit> hit = project_point(camera.camera, camera.world_from_camera, place);
  if (!hit) return std::nullopt;
  return PixelPoint{hit->u, hit->v};
}

SurfaceDistance distance_in(const SurfaceMap& map) {
  return [&map](std::int32_t column, std::int32_t row) {
    return map.empty() ? 0.0 : static_cast<double>(map.at(column, row));
  };
}

std::optional<PixelPoint> seen_at(const RayCamera& camera, const SurfaceDistance& distance, Vec3d place,
                                  double tolerance_m) {
  const std::optional<PixelPoint> at = pixel_of(camera, place);
  if (!at) return at;
  const PixelPlace pixel = pixel_at(camera.camera, *at);
  const double surface = distance(pixel.column, pixel.row), own = length(place - camera.world_from_camera.t);
  const bool is_seen = surface > 0 && std::abs(own - surface) <= std::max(tolerance_m, kSameDistance * surface);
  return is_seen ? at : std::nullopt;
}

void MarkPlaces::set(std::span<const Annotations::Mark> marks, std::span<const int> view_of_frame) {
  std::unordered_map<std::string, Placed*> before;
  for (Placed& placed : marks_) before.emplace(placed.id, &placed);
  std::vector<Placed> now;
  for (const Annotations::Mark& mark : marks) {
    const int view = view_of_frame[static_cast<std::size_t>(mark.frame)];
    if (view < 0 || mark.class_index == kVoid) continue;  // what is ignored is so in its own view alone
    const auto known = before.find(mark.id);
    if (known != before.end()) {
      now.push_back(std::move(*known->second));
    } else {
      now.push_back({mark.id, view, some_pixels(mark.points), {}, -1});
    }
  }
  marks_ = std::move(now);
}

std::vector<SeenMark> MarkPlaces::seen_by(const RayCamera& camera, const SurfaceDistance& distance, int own,
                                          std::span<const PoolView> views, const RayLimits& limits,
                                          double tolerance_m) {
  std::vector<SeenMark> seen;
  for (auto mark = marks_.rbegin(); mark != marks_.rend() && seen.size() < kMostSeen; ++mark) {
    if (mark->view == own) continue;
    const PoolView& view = views[static_cast<std::size_t>(mark->view)];
    if (view.map.empty()) continue;
    if (mark->step != view.map.step) {
      mark->step = view.map.step;
      mark->places.clear();
      for (const PixelPlace& pixel : mark->pixels) {
        const double way = static_cast<double>(view.map.at(pixel.column, pixel.row));
        if (way > 0) mark->places.push_back(point_at(view.camera, limits, pixel, way));
      }
    }
    std::vector<PixelPoint> points;
    for (const Vec3d& place : mark->places)
      if (const auto at = seen_at(camera, distance, place, tolerance_m)) points.push_back(*at);
    if (!points.empty()) seen.push_back({mark->id, std::move(points)});
  }
  return seen;
}

std::optional<Spot> best_spot(std::span<const PoolView> views, Vec3d place, double tolerance_m) {
  std::optional<Spot> best;
  double most = 0;
  for (std::size_t v = 0; v < views.size(); ++v) {
    const RayCamera& camera = views[v].camera;
    const auto at = seen_at(camera, distance_in(views[v].map), place, tolerance_m);
    if (!at) continue;
    const double w = camera.camera.width_px, h = camera.camera.height_px;
    const double inside = std::min(std::min(at->x, w - at->x), std::min(at->y, h - at->y));
    if (inside < kSpotMargin_px) continue;
    const double middle = 1 - 0.5 * (std::pow(2 * at->x / w - 1, 2) + std::pow(2 * at->y / h - 1, 2)) / 2;
    const double worth = middle * camera.camera.fx / w / length(place - camera.world_from_camera.t);
    if (worth <= most) continue;
    most = worth;
    best = Spot{static_cast<int>(v), *at};
  }
  return best;
}

int nearest_view(std::span<const PoolView> views, const Pose& world_from_camera, double scale_m) {
  int nearest = -1;
  double least = INFINITY;
  for (std::size_t v = 0; v < views.size(); ++v) {
    const Pose& pose = views[v].camera.world_from_camera;
    const double apart =
        length(pose.t - world_from_camera.t) / scale_m + 1 - dot(pose.axis(2), world_from_camera.axis(2));
    if (apart >= least) continue;
    least = apart;
    nearest = static_cast<int>(v);
  }
  return nearest;
}

}  // namespace semfield
