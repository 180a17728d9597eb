// Cells of a regular grid that hold points of a surface: numbered as they are met, with their neighbours.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <unordered_map>
#include <vector>

#include "fuse/correspondence.h"

namespace semfield {

/// Two cells that touch in a face, an edge or a corner.
struct CellPair {
  std::int32_t a = 0, b = 0;
};

class SurfaceCells {
 public:
  /// Throws Error(internal) for an edge that is not positive.
  explicit SurfaceCells(double edge_m);

  double edge_m() const { return edge_m_; }
  /// The cell that holds `point`, a new one when it is the first in it; -1 for a point that is not finite or more than
  /// a million cells from the origin.
  std::int32_t add(Vec3d point);
  std::int32_t count() const { return static_cast<std::int32_t>(places_.size()); }
  /// Every two cells of which each is one of the other's 26 neighbours, once; in the order of the first one's number.
  std::vector<CellPair> neighbours() const;

 private:
  using Place = std::array<std::int32_t, 3>;
  static std::uint64_t key_of(const Place& place);
  double edge_m_;
  std::unordered_map<std::uint64_t, std::int32_t> index_;
  std::vector<Place> places_;
};

/// World points of a view's pixels [H * W]; NaN where a pixel has none (surface_point).
std::vector<Vec3d> surface_points(const PosedDepth& view);
bool is_point(Vec3d point);

/// Unit normals of a view's pixels [H * W], towards the camera: the cross product of the ways to the nearer of the two
/// neighbours along the row and along the column, so that edges of depth do not turn them. Zero where there is none.
std::vector<Vec3d> surface_normals(const PosedDepth& view, std::span<const Vec3d> points);

}  // namespace semfield
