#include "surface/mesh/depth_fusion.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "compute/parallel.h"

namespace semfield {

namespace {

// Between normal and ray: who looks along a face does not vouch for it, and who looks slantingly may be off by more.
constexpr double kLeastCosine = 0.2, kSlantCosine = 0.5;
// Four pixels whose distances differ by more cells, and more than those of a face at kLeastCosine would, lie on both
// sides of an edge.
constexpr double kEdgeCells = 1.5, kMostSlope = 4.9;  // the tangent of that angle
constexpr int kLeastAgree = 2;                        // views; of a point that a single one can see, that one

// A view asked at points of space.
class Witness {
 public:
  Witness(const DepthView& view, const RayLimits& limits, double cell)
      : view_(view),
        camera_(view.camera.camera),
        near_(limits.near_m),
        edge_(kEdgeCells * cell),
        slant_(kMostSlope * view.map.stride / std::min(view.camera.camera.fx, view.camera.camera.fy)) {
    if (!view.camera.undistort) camera_.k1 = camera_.k2 = camera_.k3 = camera_.k4 = camera_.p1 = camera_.p2 = 0;
    for (std::int32_t y = 0; y < view.map.height_px; ++y)
      for (std::int32_t x = 0; x < view.map.width_px; ++x) between_.push_back(is_between(x, y) ? 1 : 0);
  }

  struct Reading {
    double seen = 0;       // distance of what the pixel shows; infinite: nothing
    bool at_edge = false;  // the pixels around differ: `seen` is the least of them, and what lies there is not known
    double own = 0;        // distance of the point
  };
  /// Between the way from the camera to the point and the normal.
  double cosine(Vec3d point, Vec3d normal) const {
    const Vec3d way = point - view_.camera.world_from_camera.t;
    return dot(way, normal) / length(way);
  }
  // None for a point outside the image, nearer than rays begin, or at a pixel of which nothing is known.
  std::optional<Reading> at(Vec3d point) const {
    const Vec3d p = view_.camera.world_from_camera.apply_inverse(point);
    const double own = length(p);
    if (!camera_.sees(p) || own < near_ || !camera_.is_within_lens(p)) return std::nullopt;
    double u = 0, v = 0;
    camera_.project(p, u, v);
    if (!(u >= 0 && v >= 0 && u < camera_.width_px && v < camera_.height_px)) return std::nullopt;
    Reading reading = pixels_around(u, v);
    if (std::isnan(reading.seen)) return std::nullopt;
    reading.own = own;
    return reading;
  }

 private:
  double value(std::int32_t x, std::int32_t y) const {
    const float d = view_.map.distance_m[static_cast<std::size_t>(std::int64_t{y} * view_.map.width_px + x)];
    return d == 0 ? HUGE_VAL : static_cast<double>(d);
  }
  // Rendered depth is a mean over what a pixel meets, so at an edge it may lie between the two surfaces, on neither.
  bool is_between(std::int32_t x, std::int32_t y) const {
    double least = HUGE_VAL, most = 0;
    for (std::int32_t v = std::max(0, y - 1); v <= std::min(view_.map.height_px - 1, y + 1); ++v) {
      for (std::int32_t u = std::max(0, x - 1); u <= std::min(view_.map.width_px - 1, x + 1); ++u) {
        least = std::min(least, value(u, v));  // what is not known changes neither
        most = std::max(most, value(u, v));
      }
    }
    const double own = value(x, y), edge = edge_ + slant_ * least;
    return own - least > edge && most - own > edge;
  }
  Reading pixels_around(double u, double v) const {
    const SurfaceMap& map = view_.map;
    const double first = 0.5 + map.stride / 2;  // of the map's first pixel (strided_place)
    const double x = std::clamp((u - first) / map.stride, 0.0, map.width_px - 1.0);
    const double y = std::clamp((v - first) / map.stride, 0.0, map.height_px - 1.0);
    const auto x0 = static_cast<std::int32_t>(x), y0 = static_cast<std::int32_t>(y);
    const std::int32_t x1 = std::min(x0 + 1, map.width_px - 1), y1 = std::min(y0 + 1, map.height_px - 1);
    const double a = value(x0, y0), b = value(x1, y0), c = value(x0, y1), d = value(x1, y1);
    const double fx = x - x0, fy = y - y0;
    if (std::isnan(a + b + c + d)) return {value(fx < 0.5 ? x0 : x1, fy < 0.5 ? y0 : y1)};
    const auto [least, most] = std::minmax({a, b, c, d});
    if (least == HUGE_VAL) return {HUGE_VAL};
    if (!(most - least < edge_ + slant_ * least)) {
      const std::int32_t nx = fx < 0.5 ? x0 : x1, ny = fy < 0.5 ? y0 : y1;
      const bool between = between_[static_cast<std::size_t>(std::int64_t{ny} * map.width_px + nx)] != 0;
      return between ? Reading{least, true} : Reading{value(nx, ny)};
    }
    return {(1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)};
  }

  const DepthView& view_;
  Camera camera_;
  double near_, edge_, slant_;  // `slant_`: more of the distance from a pixel to the next
  std::vector<char> between_;   // of each pixel
};

// Minus the mean signed distance in truncations: dense is positive. 1 where no view speaks.
double solidity(std::span<const Witness> witnesses, Vec3d point, double cell) {
  const double truncation = kTruncationCells * cell;
  double sum = 0, weights = 0;
  for (const Witness& witness : witnesses) {
    const auto reading = witness.at(point);
    if (!reading) continue;
    const double signed_distance = reading->seen - reading->own;
    if (signed_distance < (reading->at_edge ? truncation : -truncation)) continue;
    const double weight = 1 / reading->own;
    sum += weight * std::min(signed_distance / truncation, 1.0);
    weights += weight;
  }
  return weights > 0 ? -sum / weights : 1;
}

// Whether views put a surface within `most` of the point: kLeastAgree of those that can see so far, or all of fewer.
bool is_agreed(std::span<const Witness> witnesses, Vec3d point, Vec3d normal, double most) {
  int agree = 0, can_see = 0;
  for (const Witness& witness : witnesses) {
    const double cosine = std::abs(witness.cosine(point, normal));
    if (cosine < kLeastCosine) continue;
    const auto reading = witness.at(point);
    const double along = most / std::max(kSlantCosine, cosine);
    if (!reading || reading->own > reading->seen + along) continue;
    ++can_see;
    if (!reading->at_edge && std::abs(reading->seen - reading->own) <= along) ++agree;
    if (agree >= kLeastAgree) return true;
  }
  return agree > 0 && agree == can_see;
}

}  // namespace

std::vector<DepthView> depth_views(Pipeline<float>& pipeline, std::span<const RayCamera> cameras,
                                   const RayLimits& limits, std::int64_t rays,
                                   const std::function<void(std::size_t)>& done) {
  double pixels = 0;
  for (const RayCamera& one : cameras) pixels += static_cast<double>(one.camera.width_px) * one.camera.height_px;
  const auto stride =
      static_cast<std::int32_t>(std::ceil(std::sqrt(std::max(1.0, pixels / static_cast<double>(rays)))));
  std::vector<DepthView> views;
  for (const RayCamera& camera : cameras) {
    views.push_back({camera, make_surface_map(pipeline, camera, limits, stride, 0)});
    if (done) done(views.size());
  }
  return views;
}

Surface fused_surface(std::span<const DepthView> views, const RayLimits& limits, const VoxelGrid& grid) {
  std::vector<Witness> witnesses;
  for (const DepthView& view : views) witnesses.emplace_back(view, limits, grid.spacing);
  Surface surface = marching_cubes(grid, 0, [&](std::int64_t z, std::span<double> values) {
    parallel_for(grid.ny, [&](std::int64_t y) {
      for (std::int64_t x = 0; x < grid.nx; ++x) {
        const Vec3d point = grid.world({static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)});
        values[static_cast<std::size_t>(y * grid.nx + x)] = solidity(witnesses, point, grid.spacing);
      }
    });
  });
  set_vertex_normals(surface);
  std::vector<char> agreed(surface.positions.size());
  parallel_for((std::ssize(agreed) + 1023) / 1024, [&](std::int64_t block) {
    const auto end = std::min(agreed.size(), static_cast<std::size_t>((block + 1) * 1024));
    for (auto i = static_cast<std::size_t>(block * 1024); i < end; ++i)
      agreed[i] = is_agreed(witnesses, surface.positions[i], surface.normals[i], kAgreeCells * grid.spacing) ? 1 : 0;
  });
  std::vector<char> keep;
  for (const Triangle& t : surface.triangles) keep.push_back(agreed[t[0]] & agreed[t[1]] & agreed[t[2]]);
  keep_triangles(surface, keep);
  set_vertex_normals(surface);
  return surface;
}

}  // namespace semfield
