#include "surface/fuse/correspondence.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace semfield {

namespace {

bool valid_depth(float z) { return z > 0 && std::isfinite(z); }

double median_depth(std::span<const float> depth_m) {
  std::vector<float> valid;
  for (const float z : depth_m) {
    if (valid_depth(z)) valid.push_back(z);
  }
  if (valid.empty()) return 1;
  const auto middle = valid.begin() + static_cast<std::ptrdiff_t>(valid.size() / 2);
  std::nth_element(valid.begin(), middle, valid.end());
  return *middle;
}

}  // namespace

bool same_surface(const PosedDepth& view, std::size_t pixel, double z_m, const FusionParams& params) {
  const float z = view.depth_m[pixel];
  return valid_depth(z) && params.agree(z_m, z);
}

std::optional<PixelHit> seen_at(const PosedDepth& view, Vec3d point, const FusionParams& params) {
  const std::optional<PixelHit> hit = project_point(view.camera, view.world_from_camera, point);
  if (!hit || !same_surface(view, view.pixel(hit->column, hit->row), hit->z_m, params)) return std::nullopt;
  return hit;
}

std::vector<int> choose_views(std::span<const PosedDepth> views, int target, std::vector<int> others,
                              const FusionParams& params) {
  const auto wanted = static_cast<std::size_t>(params.views);
  if (wanted == 0 || wanted >= others.size()) return others;
  std::vector<int> chosen;
  if (params.choose == ViewChoice::even) {
    for (std::size_t k = 0; k < wanted; ++k) chosen.push_back(others[(2 * k + 1) * others.size() / (2 * wanted)]);
    return chosen;
  }
  const double reach = median_depth(views[static_cast<std::size_t>(target)].depth_m);
  const auto gaze = [&](const Pose& pose) { return pose.t + pose.axis(2) * reach; };
  const Pose& own = views[static_cast<std::size_t>(target)].world_from_camera;
  std::vector<std::pair<double, int>> by_distance;
  for (const int other : others) {
    const Pose& pose = views[static_cast<std::size_t>(other)].world_from_camera;
    by_distance.emplace_back(length(pose.t - own.t) + length(gaze(pose) - gaze(own)), other);
  }
  std::sort(by_distance.begin(), by_distance.end());
  for (std::size_t k = 0; k < wanted; ++k) chosen.push_back(by_distance[k].second);
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

}  // namespace semfield
