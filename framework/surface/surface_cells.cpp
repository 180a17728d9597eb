#include "surface/surface_cells.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {
constexpr std::int32_t kFarthest = 1 << 20;     // cells from the first along an axis; 21 bits of a key
constexpr std::int32_t kFarthestOf0 = 1 << 30;  // cells from 0
constexpr std::size_t kFirstEntries = 1024;
constexpr std::int64_t kBlock = 4096;  // cells of a unit of work
}  // namespace

// Its entry, or the free one where it belongs. The upper bits of a product with an odd number depend on all bits of the
// key.
std::size_t CellIndex::place_of(std::uint64_t key) const {
  const int bits = std::countr_zero(entries_.size());
  std::size_t place = (key * 0x9E3779B97F4A7C15U) >> (64 - bits);
  while (entries_[place].number >= 0 && entries_[place].key != key) place = (place + 1) & (entries_.size() - 1);
  return place;
}

std::int32_t CellIndex::find(std::uint64_t key) const { return entries_.empty() ? -1 : entries_[place_of(key)].number; }

std::int32_t CellIndex::add(std::uint64_t key, std::int32_t fresh) {
  if (2 * used_ >= entries_.size()) grow();
  Entry& entry = entries_[place_of(key)];
  if (entry.number < 0) {
    entry = {key, fresh};
    ++used_;
  }
  return entry.number;
}

void CellIndex::grow() {
  const std::vector<Entry> before = std::exchange(entries_, {});
  entries_.resize(std::max(kFirstEntries, 4 * before.size()));
  for (const Entry& entry : before)
    if (entry.number >= 0) entries_[place_of(entry.key)] = entry;
}

SurfaceCells::SurfaceCells(double edge_m) : edge_m_(edge_m) {
  SEMFIELD_CHECK(edge_m > 0 && std::isfinite(edge_m), "a cell's edge is a positive length");
}

// Counted from the first cell: scenes may lie far from 0.
std::uint64_t SurfaceCells::key_of(const SurfaceCell& place) const {
  std::uint64_t key = 0;
  for (std::size_t k = 0; k < 3; ++k)
    key = key << 21 | static_cast<std::uint64_t>(place[k] - (places_.empty() ? place[k] : places_[0][k]) + kFarthest);
  return key;
}

bool SurfaceCells::fits(const SurfaceCell& place) const {
  for (std::size_t k = 0; k < 3; ++k) {
    if (std::abs(std::int64_t{place[k]}) >= kFarthestOf0) return false;
    if (!places_.empty() && std::abs(place[k] - places_[0][k]) >= kFarthest - 1) return false;
  }
  return true;
}

bool SurfaceCells::find_place(Vec3d point, SurfaceCell& place) const {
  for (int axis = 0; axis < 3; ++axis) {
    const double at = std::floor(point[axis] / edge_m_);
    if (!(std::abs(at) < kFarthestOf0)) return false;  // NaN too
    place[static_cast<std::size_t>(axis)] = static_cast<std::int32_t>(at);
  }
  return fits(place);
}

std::int32_t SurfaceCells::add(Vec3d point) {
  SurfaceCell place{};
  return find_place(point, place) ? add(place) : -1;
}

std::int32_t SurfaceCells::add(const SurfaceCell& place) {
  if (!fits(place)) return -1;
  const std::int32_t number = index_.add(key_of(place), count());
  if (number == count()) places_.push_back(place);
  return number;
}

std::int32_t SurfaceCells::near(Vec3d point) const {
  SurfaceCell own{};
  if (places_.empty() || !find_place(point, own)) return -1;
  if (const std::int32_t found = index_.find(key_of(own)); found >= 0) return found;
  std::int32_t nearest = -1;
  double least = INFINITY;
  for (std::int32_t k = 0; k < 27; ++k) {
    const SurfaceCell other{own[0] + k % 3 - 1, own[1] + k / 3 % 3 - 1, own[2] + k / 9 - 1};
    const std::int32_t found = index_.find(key_of(other));
    if (found < 0) continue;
    const Vec3d center{(other[0] + 0.5) * edge_m_, (other[1] + 0.5) * edge_m_, (other[2] + 0.5) * edge_m_};
    const double distance = length(center - point);
    if (distance >= least) continue;
    least = distance;
    nearest = found;
  }
  return nearest;
}

std::vector<CellPair> SurfaceCells::neighbours() const {
  std::vector<std::vector<CellPair>> of_block(static_cast<std::size_t>((count() + kBlock - 1) / kBlock));
  parallel_for(std::ssize(of_block), [&](std::int64_t block) {
    for (std::int64_t cell = block * kBlock; cell < std::min<std::int64_t>(count(), (block + 1) * kBlock); ++cell) {
      const SurfaceCell& own = place(static_cast<std::int32_t>(cell));
      for (int offset = 14; offset < 27; ++offset) {  // the half of the 27 behind the cell itself
        const SurfaceCell other{own[0] + offset / 9 - 1, own[1] + offset / 3 % 3 - 1, own[2] + offset % 3 - 1};
        if (const std::int32_t found = index_.find(key_of(other)); found >= 0)
          of_block[static_cast<std::size_t>(block)].push_back({static_cast<std::int32_t>(cell), found});
      }
    }
  });
  std::vector<CellPair> pairs;
  for (const std::vector<CellPair>& some : of_block) pairs.insert(pairs.end(), some.begin(), some.end());
  return pairs;
}

}  // namespace semfield
