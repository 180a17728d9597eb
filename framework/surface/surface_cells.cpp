#include "surface/surface_cells.h"

#include <cmath>

#include "core/check.h"

namespace semfield {

namespace {
constexpr std::int32_t kFarthest = 1 << 20;  // cells from the origin along an axis; 21 bits of a key
}

SurfaceCells::SurfaceCells(double edge_m) : edge_m_(edge_m) {
  SEMFIELD_CHECK(edge_m > 0 && std::isfinite(edge_m), "a cell's edge is a positive length");
}

std::uint64_t SurfaceCells::key_of(const SurfaceCell& place) {
  std::uint64_t key = 0;
  for (const std::int32_t coordinate : place) key = key << 21 | static_cast<std::uint64_t>(coordinate + kFarthest);
  return key;
}

bool SurfaceCells::find_place(Vec3d point, SurfaceCell& place) const {
  for (int axis = 0; axis < 3; ++axis) {
    const double at = std::floor(point[axis] / edge_m_);
    if (!(std::abs(at) < kFarthest - 1)) return false;  // NaN too
    place[static_cast<std::size_t>(axis)] = static_cast<std::int32_t>(at);
  }
  return true;
}

std::int32_t SurfaceCells::add(Vec3d point) {
  SurfaceCell place{};
  return find_place(point, place) ? add(place) : -1;
}

std::int32_t SurfaceCells::add(const SurfaceCell& place) {
  const auto [found, fresh] = index_.try_emplace(key_of(place), count());
  if (fresh) places_.push_back(place);
  return found->second;
}

std::int32_t SurfaceCells::near(Vec3d point) const {
  SurfaceCell own{};
  if (places_.empty() || !find_place(point, own)) return -1;
  if (const auto found = index_.find(key_of(own)); found != index_.end()) return found->second;
  std::int32_t nearest = -1;
  double least = INFINITY;
  for (std::int32_t k = 0; k < 27; ++k) {
    const SurfaceCell other{own[0] + k % 3 - 1, own[1] + k / 3 % 3 - 1, own[2] + k / 9 - 1};
    const auto found = index_.find(key_of(other));
    if (found == index_.end()) continue;
    const Vec3d center{(other[0] + 0.5) * edge_m_, (other[1] + 0.5) * edge_m_, (other[2] + 0.5) * edge_m_};
    const double distance = length(center - point);
    if (distance >= least) continue;
    least = distance;
    nearest = found->second;
  }
  return nearest;
}

std::vector<CellPair> SurfaceCells::neighbours() const {
  std::vector<CellPair> pairs;
  for (std::int32_t cell = 0; cell < count(); ++cell) {
    const SurfaceCell& own = place(cell);
    for (int offset = 14; offset < 27; ++offset) {  // the half of the 27 behind the cell itself
      const SurfaceCell other{own[0] + offset / 9 - 1, own[1] + offset / 3 % 3 - 1, own[2] + offset % 3 - 1};
      const auto found = index_.find(key_of(other));
      if (found != index_.end()) pairs.push_back({cell, found->second});
    }
  }
  return pairs;
}

}  // namespace semfield
