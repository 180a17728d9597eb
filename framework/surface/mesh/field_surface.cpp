#include "surface/mesh/field_surface.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "compute/parallel.h"

namespace semfield {

namespace {
constexpr std::int64_t kBatch = std::int64_t{1} << 16;  // points, or rays, evaluated at once
constexpr float kLeastOpacity = 1e-3F;                  // below it a ray meets nothing
constexpr std::size_t kLevels = 19;
constexpr double kMostCellsOff = 8;

double candidate(double spacing, std::size_t k) {
  return half_opaque_density(spacing) * std::exp2(-0.5 * static_cast<double>(k));
}

// body(i) for every i in [0, count), a piece of them in a thread.
template <class Body>
void for_points(std::int64_t count, const Body& body) {
  constexpr std::int64_t kPiece = 2048;
  parallel_for((count + kPiece - 1) / kPiece, [&](std::int64_t piece) {
    for (std::int64_t i = piece * kPiece; i < std::min(count, (piece + 1) * kPiece); ++i) body(i);
  });
}

void close_border(const VoxelGrid& grid, std::int64_t z, std::span<double> values) {
  for (std::int64_t i = 0; i < grid.layer_points(); ++i) {
    const std::int64_t x = i % grid.nx, y = i / grid.nx;
    const bool border = x == 0 || y == 0 || z == 0 || x == grid.nx - 1 || y == grid.ny - 1 || z == grid.nz - 1;
    if (border) values[static_cast<std::size_t>(i)] = 1;
  }
}

}  // namespace

double half_opaque_density(double spacing) { return std::log(2.0) / spacing; }

Surface density_surface(const Pipeline<float>& pipeline, const SurfaceRequest& request) {
  const VoxelGrid& grid = request.grid;
  std::vector<double> position(static_cast<std::size_t>(3 * kBatch));
  std::vector<float> sigma(static_cast<std::size_t>(kBatch));
  Surface surface = marching_cubes(grid, 0.5, [&](std::int64_t z, std::span<double> values) {
    for (std::int64_t begin = 0; begin < grid.layer_points(); begin += kBatch) {
      const std::int64_t count = std::min(kBatch, grid.layer_points() - begin);
      for_points(count, [&](std::int64_t i) {
        const Vec3d p = grid.world({static_cast<double>((begin + i) % grid.nx),
                                    static_cast<double>((begin + i) / grid.nx), static_cast<double>(z)});
        for (int axis = 0; axis < 3; ++axis) position[static_cast<std::size_t>(3 * i + axis)] = p[axis];
      });
      pipeline.executor().density({position.data(), count, 3}, {sigma.data(), count, 1});
      for_points(count, [&](std::int64_t i) {
        const auto density = static_cast<double>(sigma[static_cast<std::size_t>(i)]);
        values[static_cast<std::size_t>(begin + i)] = 1 - std::exp2(-density / request.level_per_m);
      });
    }
    if (request.opaque_border) close_border(grid, z, values);
  });
  set_vertex_normals(surface);
  return surface;
}

double choose_level(const Pipeline<float>& pipeline, const SurfaceRequest& request, std::span<const DepthView> views,
                    const RayLimits& limits) {
  const double spacing = request.grid.spacing, most = kMostCellsOff * spacing;
  const Vec3d last{static_cast<double>(request.grid.nx - 1), static_cast<double>(request.grid.ny - 1),
                   static_cast<double>(request.grid.nz - 1)};
  const Box box{request.grid.world({0, 0, 0}), request.grid.world(last)};
  std::array<double, kLevels> off{};
  struct Line {
    double surface, from, to;
    bool ends_at_border;
    std::size_t begin, end;  // of its points
  };
  std::vector<Line> asked;
  std::vector<double> position;
  std::vector<float> sigma;
  const auto compare = [&] {  // with the densities of the lines evaluated, which are then done
    sigma.resize(position.size() / 3);
    const auto points = std::ssize(sigma);
    pipeline.executor().density({position.data(), points, 3}, {sigma.data(), points, 1});
    for (const Line& line : asked) {
      const std::span<const float> densities(sigma.data() + line.begin, line.end - line.begin);
      for (std::size_t k = 0; k < kLevels; ++k) {
        const double level = candidate(spacing, k);
        const auto first =
            std::find_if(densities.begin(), densities.end(), [&](float s) { return static_cast<double>(s) > level; });
        double at = line.from + static_cast<double>(first - densities.begin()) * spacing;
        if (first == densities.end()) at = line.ends_at_border ? line.to : line.surface + most;
        off[k] += std::min(most, std::abs(at - line.surface));
      }
    }
    asked.clear();
    position.clear();
  };
  const auto add_line = [&](Vec3d origin, Vec3d direction, double near, double surface) {
    // Beyond the surface by more than counts, nothing is learned; a border that is opaque ends every line.
    double enter = 0, leave = 0;
    if (!intersect(box, origin, direction, enter, leave)) return;
    const double from = std::max(near, enter), to = std::min(surface + most, leave);
    const auto steps = static_cast<std::int64_t>(std::max(0.0, (to - from) / spacing)) + 1;
    const std::size_t begin = position.size() / 3;
    asked.push_back(
        {surface, from, to, request.opaque_border && to == leave, begin, begin + static_cast<std::size_t>(steps)});
    for (std::int64_t i = 0; i < steps; ++i) {
      const Vec3d p = origin + direction * (from + static_cast<double>(i) * spacing);
      for (int axis = 0; axis < 3; ++axis) position.push_back(p[axis]);
    }
    if (std::ssize(position) >= 3 * kBatch) compare();
  };
  for (const DepthView& view : views) {
    for (std::size_t i = 0; i < view.map.distance_m.size(); ++i) {
      if (!(view.map.distance_m[i] > 0)) continue;
      const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
      std::array<double, 3> o{}, d{};
      std::array<double, 2> near_far{};
      cast_ray(view.camera, limits, at.column, at.row, o.data(), d.data(), near_far.data());
      add_line({o[0], o[1], o[2]}, {d[0], d[1], d[2]}, near_far[0], static_cast<double>(view.map.distance_m[i]));
    }
  }
  if (!asked.empty()) compare();
  const auto best = std::min_element(off.begin(), off.end()) - off.begin();
  return candidate(spacing, static_cast<std::size_t>(best));
}

PointAttributes render_attributes(Pipeline<float>& pipeline, const Surface& surface, std::span<const RayCamera> cameras,
                                  std::span<const Sights> sights, const RayLimits& limits,
                                  const ClassOfLogit& class_of_logit) {
  PointAttributes out;
  if (!pipeline.has_semantics()) return out;
  out.label.assign(surface.positions.size(), kVoid);
  const auto most = static_cast<float>(std::log(static_cast<double>(class_of_logit.size())));
  out.entropy.assign(surface.positions.size(), most);
  std::vector<double> origin, direction, near_far;
  std::vector<std::size_t> vertex;  // of each ray
  const auto render = [&] {
    const auto count = std::ssize(vertex);
    std::vector<float> opacity(vertex.size()), entropy(vertex.size());
    std::vector<std::int16_t> label(vertex.size());
    RenderJob<float> job;
    job.origin = {origin.data(), count, 3};
    job.direction = {direction.data(), count, 3};
    job.near_far = {near_far.data(), count, 2};
    job.opacity = {opacity.data(), count, 1};
    job.label = {label.data(), count, 1};
    job.entropy = {entropy.data(), count, 1};
    pipeline.executor().render(job);
    for (std::size_t r = 0; r < vertex.size(); ++r) {
      const bool better = out.label[vertex[r]] == kVoid || entropy[r] < out.entropy[vertex[r]];
      if (!(opacity[r] > kLeastOpacity && better)) continue;
      out.label[vertex[r]] = static_cast<std::int16_t>(class_of_logit[static_cast<std::size_t>(label[r])]);
      out.entropy[vertex[r]] = entropy[r];
    }
    vertex.clear();
  };
  for (std::size_t v = 0; v < sights.size(); ++v) {
    for (const std::int32_t number : sights[v].camera) {
      if (number < 0) continue;
      const RayCamera& eye = cameras[static_cast<std::size_t>(number)];
      const std::size_t r = vertex.size();
      vertex.push_back(v);
      origin.resize(3 * r + 3);
      direction.resize(3 * r + 3);
      near_far.resize(2 * r + 2);
      const Vec3d along = normalized(surface.positions[v] - eye.world_from_camera.t);
      ray_of_direction(eye.world_from_camera.unrotate(along), eye.world_from_camera,
                       {eye.camera.has_finite_lens(), eye.camera.is_wide()}, limits, &origin[3 * r], &direction[3 * r],
                       &near_far[2 * r]);
    }
    if (std::ssize(vertex) + std::ssize(sights[v].camera) > kBatch || v + 1 == sights.size()) render();
  }
  return out;
}

namespace {

// Between normal and ray: who looks along a face does not vouch for it, and who looks slantingly may be off by more.
constexpr double kLeastFusedCosine = 0.2, kSlantCosine = 0.5;
// Four pixels whose distances differ by more cells, and more than those of a face at kLeastFusedCosine would, lie on
// both sides of an edge.
constexpr double kEdgeCells = 1.5, kMostSlope = 4.9;  // the tangent of that angle
constexpr int kSmoothRounds = 10;
constexpr int kLeastAgree = 2;  // views; of a point that a single one can see, that one

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

// Whether views put a surface within `most` of the point: kLeastAgree of those that can see so far, or all of fewer;
// of guesses kLeastGuesses and half of them.
bool is_agreed(std::span<const Witness> witnesses, Vec3d point, Vec3d normal, double most, bool guessed) {
  int agree = 0, can_see = 0;
  for (const Witness& witness : witnesses) {
    const double cosine = std::abs(witness.cosine(point, normal));
    if (cosine < kLeastFusedCosine) continue;
    const auto reading = witness.at(point);
    const double along = most / std::max(kSlantCosine, cosine);
    if (!reading || reading->own > reading->seen + along) continue;
    ++can_see;
    if (!reading->at_edge && std::abs(reading->seen - reading->own) <= along) ++agree;
    if (!guessed && agree >= kLeastAgree) return true;
  }
  return guessed ? agree >= kLeastGuesses && 2 * agree >= can_see : agree > 0 && agree == can_see;
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

Surface fused_surface(std::span<const DepthView> views, const RayLimits& limits, const VoxelGrid& grid, bool guessed) {
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
      agreed[i] =
          is_agreed(witnesses, surface.positions[i], surface.normals[i], kAgreeCells * grid.spacing, guessed) ? 1 : 0;
  });
  if (guessed) {
    const Edges edges = edges_of(surface);
    for (const int rings : {kSlitRings, -2 * kSlitRings, kSlitRings}) agreed = grown(edges, std::move(agreed), rings);
  }
  std::vector<char> keep;
  for (const Triangle& t : surface.triangles) keep.push_back(agreed[t[0]] & agreed[t[1]] & agreed[t[2]]);
  keep_triangles(surface, keep);
  if (guessed) smooth(surface, kSmoothRounds);
  set_vertex_normals(surface);
  return surface;
}

}  // namespace semfield
