// Number the cells of a regular grid that hold points of a surface, and find their neighbours.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/small_math.h"

namespace semfield {

/// Place of a cell in the grid, in cells from the origin.
using SurfaceCell = std::array<std::int32_t, 3>;

/// Two cells that touch in a face, an edge or a corner.
struct CellPair {
  std::int32_t a = 0, b = 0;
};

/// Numbers by key, in one table that is at most half full: a key lies at the first free place from its hash on.
class CellIndex {
 public:
  /// The number of `key`, or -1.
  std::int32_t find(std::uint64_t key) const;
  /// The number of `key`, which is `fresh` where it had none.
  std::int32_t add(std::uint64_t key, std::int32_t fresh);

 private:
  struct Entry {
    std::uint64_t key = 0;
    std::int32_t number = -1;  // -1: free
  };
  std::size_t place_of(std::uint64_t key) const;
  void grow();
  std::vector<Entry> entries_;  // a power of two of them, or none
  std::size_t used_ = 0;
};

/// Cells get numbers from 0 on as they are met.
class SurfaceCells {
 public:
  SurfaceCells() = default;
  /// `edge_m`: of a cell. Throws Error(internal) where it is not positive.
  explicit SurfaceCells(double edge_m);

  double edge_m() const { return edge_m_; }
  /// The cell that holds `point`, a new one when it is the first in it; -1 for a point that is not finite, more than a
  /// million cells from the first one, or more than a billion from 0.
  std::int32_t add(Vec3d point);
  std::int32_t add(const SurfaceCell& place);  ///< likewise
  std::int32_t count() const { return static_cast<std::int32_t>(places_.size()); }
  const SurfaceCell& place(std::int32_t cell) const { return places_[static_cast<std::size_t>(cell)]; }
  /// The cell that holds `point`, else the one with the nearest centre of those that touch its place; -1: none.
  std::int32_t near(Vec3d point) const;
  /// Every two cells of which each is one of the other's 26 neighbours, once; in the order of the first one's number.
  std::vector<CellPair> neighbours() const;

 private:
  std::uint64_t key_of(const SurfaceCell& place) const;  // unique where fits()
  bool fits(const SurfaceCell& place) const;
  bool find_place(Vec3d point, SurfaceCell& place) const;
  double edge_m_ = 0;
  CellIndex index_;
  std::vector<SurfaceCell> places_;
};

}  // namespace semfield
