#include "surface/mesh/point_cloud.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/error.h"

namespace semfield {

PointCloud::PointCloud(double voxel, const std::array<double, 3>& background) : voxel_(voxel), background_(background) {
  if (!(voxel > 0) || !std::isfinite(voxel))
    throw Error(ErrorKind::usage, "mesh.voxel.size", "a voxel of " + std::to_string(voxel),
                "give a positive edge length");
}

std::size_t PointCloud::Hash::operator()(const std::array<std::int64_t, 3>& key) const {
  std::uint64_t h = 0;
  for (const std::int64_t k : key) {
    h = (h ^ static_cast<std::uint64_t>(k)) * 0x9E3779B97F4A7C15U;
    h ^= h >> 32;
  }
  return h;
}

namespace {

// From a pixel to the nearer one of its neighbours at `before` and `behind`, along the way from the first to the
// second; {0, 0, 0} where neither is seen.
Vec3d step_at(const SeenPixels& pixels, std::size_t i, std::optional<std::size_t> before,
              std::optional<std::size_t> behind) {
  Vec3d least;
  double shortest = std::numeric_limits<double>::infinity();
  const auto consider = [&](std::optional<std::size_t> other, double sign) {
    if (!other || pixels.seen[*other] == 0) return;
    const Vec3d step = sign * (pixels.place[*other] - pixels.place[i]);
    if (length(step) >= shortest) return;
    shortest = length(step);
    least = step;
  };
  consider(behind, 1);
  consider(before, -1);
  return least;
}

// What the neighbours of a pixel show. Seen at more than 84 degrees it is an edge of depth more often than a surface.
Vec3d normal_at(const SeenPixels& pixels, std::size_t i, std::int32_t width, std::int32_t height, Vec3d to_eye) {
  constexpr double kLeastCosine = 0.1;
  const std::size_t w = static_cast<std::size_t>(width), column = i % w, row = i / w;
  using Place = std::optional<std::size_t>;
  const Vec3d right = step_at(pixels, i, column > 0 ? Place(i - 1) : Place(), column + 1 < w ? Place(i + 1) : Place());
  const Vec3d down = step_at(pixels, i, row > 0 ? Place(i - w) : Place(),
                             row + 1 < static_cast<std::size_t>(height) ? Place(i + w) : Place());
  const Vec3d normal = cross(down, right);
  const double size = length(normal);
  if (!(size > 0)) return to_eye;
  const double cosine = dot(normal, to_eye) / size;
  return std::abs(cosine) < kLeastCosine ? to_eye : normal * ((cosine < 0 ? -1 : 1) / size);
}

}  // namespace

SeenPixels seen_pixels(const RayCamera& camera, const RenderedFrame& frame, float least_opacity) {
  const std::size_t count = frame.opacity.size();
  SeenPixels out{std::vector<char>(count), std::vector<Vec3d>(count), std::vector<Vec3d>(count),
                 std::vector<float>(count)};
  const Camera& c = camera.camera;
  for (std::size_t i = 0; i < count; ++i) {
    if (!(frame.opacity[i] >= least_opacity) || !(frame.depth_m[i] > 0) || !std::isfinite(frame.depth_m[i])) continue;
    const auto width = static_cast<std::size_t>(frame.width_px);
    const double u = static_cast<double>(i % width) + 0.5, v = static_cast<double>(i / width) + 0.5;
    const Vec3d ray = camera.undistort ? c.direction(u, v) : normalized(Vec3d{(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1});
    const double share = c.depth_of(ray);
    if (!(share > 0)) continue;
    const double depth = static_cast<double>(frame.depth_m[i]) / static_cast<double>(frame.opacity[i]);
    out.seen[i] = 1;
    out.place[i] = camera.world_from_camera.apply(ray * (depth / share));
    out.footprint[i] = static_cast<float>(depth / std::sqrt(c.fx * c.fy));
  }
  for (std::size_t i = 0; i < count; ++i) {
    if (out.seen[i] == 0) continue;
    const Vec3d to_eye = normalized(camera.world_from_camera.t - out.place[i]);
    out.normal[i] = normal_at(out, i, frame.width_px, frame.height_px, to_eye);
  }
  return out;
}

void PointCloud::add(const RenderedFrame& frame, const SeenPixels& pixels) {
  labels_ = labels_ || !frame.label.empty();
  for (std::size_t i = 0; i < pixels.seen.size(); ++i) {
    if (pixels.seen[i] == 0) continue;
    const Vec3d p = pixels.place[i];
    const std::array<std::int64_t, 3> key{static_cast<std::int64_t>(std::floor(p.x / voxel_)),
                                          static_cast<std::int64_t>(std::floor(p.y / voxel_)),
                                          static_cast<std::int64_t>(std::floor(p.z / voxel_))};
    const auto [found, fresh] = index_.try_emplace(key, static_cast<std::uint32_t>(cells_.size()));
    if (fresh) cells_.emplace_back();
    Cell& cell = cells_[found->second];
    cell.place_sum = cell.place_sum + p;
    cell.normal_sum = cell.normal_sum + pixels.normal[i];
    cell.footprint = fresh ? pixels.footprint[i] : std::min(cell.footprint, pixels.footprint[i]);
    const auto met = static_cast<double>(frame.opacity[i]);
    for (std::size_t k = 0; k < 3; ++k)
      cell.color_sum[k] += (static_cast<double>(frame.rgb[3 * i + k]) - (1 - met) * background_[k]) / met;
    ++cell.count;
    if (!frame.label.empty() && (fresh || frame.entropy[i] < cell.entropy)) {
      cell.label = frame.label[i];
      cell.entropy = frame.entropy[i];
    }
  }
}

PointSet PointCloud::points() const {
  PointSet out;
  for (const Cell& cell : cells_) {
    const double share = 1.0 / static_cast<double>(cell.count);
    out.positions.push_back(cell.place_sum * share);
    const double size = length(cell.normal_sum);
    out.normals.push_back(size > 0 ? cell.normal_sum * (1 / size) : Vec3d{0, 0, 1});
    out.footprint.push_back(cell.footprint);
    auto& color = out.attributes.color.emplace_back();
    for (std::size_t k = 0; k < 3; ++k)
      color[k] = static_cast<std::uint8_t>(std::lround(255 * std::clamp(cell.color_sum[k] * share, 0.0, 1.0)));
    if (!labels_) continue;
    out.attributes.label.push_back(cell.label);
    out.attributes.entropy.push_back(cell.entropy);
  }
  return out;
}

}  // namespace semfield
