#include "handover/voxel_map.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/error.h"

namespace semfield {

namespace {

constexpr float kHit = 0.85F, kMiss = -0.4F, kLeast = -2.0F, kMost = 3.5F;  // [Hornung13, Sec. 5.3]
constexpr std::int64_t kMostAlong = 4095;
constexpr std::size_t kMostCells = std::size_t{1} << 28;

}  // namespace

VoxelGridPlace VoxelGridPlace::covering(const Box& box, double edge) {
  VoxelGridPlace place;
  place.edge = edge;
  double cells = 1;
  bool fits = edge > 0 && std::isfinite(edge) && !box.empty();
  for (int axis = 0; axis < 3 && fits; ++axis) {
    const double first = std::floor(box.lo[axis] / edge), last = std::floor(box.hi[axis] / edge);
    fits = last - first < static_cast<double>(kMostAlong) && std::abs(first) < 1e15;
    if (!fits) break;
    const auto k = static_cast<std::size_t>(axis);
    place.first[k] = static_cast<std::int64_t>(first);
    place.count[k] = static_cast<std::int64_t>(last - first) + 1;
    cells *= static_cast<double>(place.count[k]);
  }
  if (!fits || cells > static_cast<double>(kMostCells))
    throw Error(ErrorKind::usage, "handover.voxels.many",
                fmt::format("cubes of {:.4g} make more than {} along an axis, or more than {} in all", edge, kMostAlong,
                            kMostCells),
                "choose a larger --voxel");
  return place;
}

std::optional<std::size_t> VoxelGridPlace::cell_of(Vec3d point) const {
  std::array<std::int64_t, 3> at{};
  for (int axis = 0; axis < 3; ++axis) {
    const auto k = static_cast<std::size_t>(axis);
    const double cell = std::floor(point[axis] / edge) - static_cast<double>(first[k]);
    if (!(cell >= 0 && cell < static_cast<double>(count[k]))) return std::nullopt;
    at[k] = static_cast<std::int64_t>(cell);
  }
  return index(at[0], at[1], at[2]);
}

VoxelMap::VoxelMap(VoxelGridPlace place)
    : place_(place),
      odds_(place.cells()),
      known_(place.cells()),
      hit_by_(place.cells()),
      crossed_by_(place.cells()),
      label_(place.cells(), kVoid),
      lead_(place.cells()) {}

// The cubes between two points in the order in which the line meets them [Amanatides87], up to the one before the last.
void VoxelMap::cross(Vec3d from, Vec3d to) {
  const Vec3d way = to - from;
  std::array<std::int64_t, 3> at{}, end{};
  std::array<int, 3> step{};
  std::array<double, 3> next{}, pace{};
  std::int64_t left = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const auto k = static_cast<std::size_t>(axis);
    const double a = from[axis] / place_.edge, d = way[axis] / place_.edge;
    at[k] = static_cast<std::int64_t>(std::floor(a)) - place_.first[k];
    end[k] = static_cast<std::int64_t>(std::floor(to[axis] / place_.edge)) - place_.first[k];
    left += std::abs(end[k] - at[k]);
    step[k] = d > 0 ? 1 : -1;
    pace[k] = d == 0 ? std::numeric_limits<double>::infinity() : std::abs(1 / d);
    next[k] = d == 0 ? pace[k] : (d > 0 ? std::floor(a) + 1 - a : a - std::floor(a)) * pace[k];
  }
  for (; left > 0; --left) {
    const bool inside = at[0] >= 0 && at[1] >= 0 && at[2] >= 0 && at[0] < place_.count[0] && at[1] < place_.count[1] &&
                        at[2] < place_.count[2];
    if (inside) crossed_by_[place_.index(at[0], at[1], at[2])] = views_;
    const std::size_t k = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
    at[k] += step[k];
    next[k] += pace[k];
  }
}

void VoxelMap::vote(std::size_t cell, std::int16_t label) {
  if (lead_[cell] == 0) label_[cell] = label;
  lead_[cell] += label_[cell] == label ? 1 : -1;
}

void VoxelMap::add(const RayCamera& camera, const RenderedFrame& frame, const SeenPixels& pixels) {
  ++views_;
  has_labels_ = has_labels_ || !frame.label.empty();
  for (std::size_t i = 0; i < pixels.seen.size(); ++i) {
    if (pixels.seen[i] == 0) continue;
    cross(camera.world_from_camera.t, pixels.place[i]);
    const std::optional<std::size_t> end = cell_of(pixels.place[i]);
    if (!end) continue;
    hit_by_[*end] = views_;
    if (!frame.label.empty() && frame.label[i] != kVoid) vote(*end, frame.label[i]);
  }
  for (std::size_t cell = 0; cell < odds_.size(); ++cell) {
    const bool hit = hit_by_[cell] == views_;
    if (!hit && crossed_by_[cell] != views_) continue;
    known_[cell] = 1;
    odds_[cell] = std::clamp(odds_[cell] + (hit ? kHit : kMiss), kLeast, kMost);
  }
}

}  // namespace semfield
