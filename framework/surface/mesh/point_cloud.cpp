#include "surface/mesh/point_cloud.h"

#include <algorithm>
#include <cmath>

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

void PointCloud::add(const RayCamera& camera, const RenderedFrame& frame, float least_opacity) {
  labels_ = labels_ || !frame.label.empty();
  const Camera& c = camera.camera;
  for (std::int32_t row = 0; row < frame.height_px; ++row) {
    for (std::int32_t column = 0; column < frame.width_px; ++column) {
      const auto i =
          static_cast<std::size_t>(row) * static_cast<std::size_t>(frame.width_px) + static_cast<std::size_t>(column);
      if (!(frame.opacity[i] >= least_opacity) || !(frame.depth_m[i] > 0) || !std::isfinite(frame.depth_m[i])) {
        continue;
      }
      const double u = column + 0.5, v = row + 0.5;
      const Vec3d ray =
          camera.undistort ? c.direction(u, v) : normalized(Vec3d{(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1});
      const double share = c.depth_of(ray);
      if (!(share > 0)) continue;
      const double z = static_cast<double>(frame.depth_m[i]) / static_cast<double>(frame.opacity[i]);
      const Vec3d p = camera.world_from_camera.apply(ray * (z / share));
      const std::array<std::int64_t, 3> key{static_cast<std::int64_t>(std::floor(p.x / voxel_)),
                                            static_cast<std::int64_t>(std::floor(p.y / voxel_)),
                                            static_cast<std::int64_t>(std::floor(p.z / voxel_))};
      const auto [found, fresh] = index_.try_emplace(key, static_cast<std::uint32_t>(cells_.size()));
      if (fresh) cells_.emplace_back();
      Cell& cell = cells_[found->second];
      cell.place_sum = cell.place_sum + p;
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
}

PointSet PointCloud::points() const {
  PointSet out;
  for (const Cell& cell : cells_) {
    const double share = 1.0 / static_cast<double>(cell.count);
    out.positions.push_back(cell.place_sum * share);
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
