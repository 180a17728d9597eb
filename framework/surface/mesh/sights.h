// Which cameras see which points of a surface, computed from the surface itself: depth images of its triangles.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "eval/evaluator.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// Cameras that show a vertex best, best first.
struct Sights {
  static constexpr std::size_t kMost = 3;
  std::array<std::int32_t, kMost> camera{-1, -1, -1};  ///< numbers in the span of cameras; -1: no further one
  std::array<float, kMost> weight{};                   ///< pixels of the camera per area of the surface
  bool lent = false;                                   ///< lend_sights: the cameras do not see it

  bool any() const { return camera[0] >= 0; }
};

/// What every vertex is seen by, a Sights each. A camera sees a vertex where it faces the camera, projects into the
/// image between near and far, and lies at most 1.5 `cell` behind the nearest triangle of its pixel. Depth images have
/// at most 512 pixels per side. Triangles count from both sides, from near on. The surface needs its normals.
std::vector<Sights> sights_of(const Surface& surface, std::span<const RayCamera> cameras, const RayLimits& limits,
                              double cell);

/// A flag per triangle: whether a camera sees it, or it belongs to what a camera sees. Those belong that
/// - lie in a gap: no more than kGapRings edges separate every vertex of the gap from vertices that are seen, so that
///   edges do not fray and creases stay closed;
/// - complete an object: their connected part is seen over all but kHiddenShare of its area.
std::vector<char> triangles_in_sight(const Surface& surface, std::span<const Sights> sights);
inline constexpr int kGapRings = 6;
inline constexpr double kHiddenShare = 0.1;

/// A vertex that no camera sees gets the sights of the nearest one along edges, where any has some.
void lend_sights(const Surface& surface, std::span<Sights> sights);

/// Directions in which points are looked at.
struct Looks {
  std::size_t count = 0;
  std::array<Vec3d, Sights::kMost> direction;     ///< unit, from the eye to the point
  std::array<std::int32_t, Sights::kMost> eye{};  ///< number of the camera that sees the point; -1: none does
  std::array<double, Sights::kMost> weight{};     ///< sum 1
};
/// From the cameras of its sights that the point faces; along the negative normal where there are none.
Looks looks_at(Vec3d point, Vec3d normal, const Sights& sights, std::span<const RayCamera> cameras);

}  // namespace semfield
