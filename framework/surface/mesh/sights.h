// Which cameras see which points of a surface, computed from the surface itself: depth images of its triangles.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "eval/evaluator.h"
#include "scene/scene.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// Cameras that show a vertex best, best first.
struct Sights {
  static constexpr std::size_t kMost = 3;
  std::array<std::int32_t, kMost> camera{-1, -1, -1};  ///< numbers in the span of cameras; -1: no further one
  std::array<float, kMost> weight{};                   ///< pixels of the camera per area of the surface

  bool any() const { return camera[0] >= 0; }
};

/// Photographs of cameras, and what they show of the vertices that the cameras see: the mean of the best, weighted by
/// pixels per area. Near a border of the picture, and far from the weighted median, a colour counts little; where a
/// pixel is masked or transparent, nothing.
struct PhotoColors {
  std::vector<const StoredFrame*> photos;               ///< of each camera; null: none
  std::vector<std::array<std::uint8_t, 3>> color = {};  ///< of each vertex, from sights_of; grey: not known
  std::vector<char> known = {};                         ///< 0: no photograph shows its part of the surface
};

/// What every vertex is seen by, a Sights each; `colors`, if not null, gets colours. A camera sees a vertex where it
/// faces the camera, projects into the image between near and far, and lies at most 1.5 `cell` behind the nearest
/// triangle of its pixel. Depth images have at most 512 pixels per side. Triangles count from both sides, from near on.
/// The surface needs its normals.
std::vector<Sights> sights_of(const Surface& surface, std::span<const RayCamera> cameras, const RayLimits& limits,
                              double cell, PhotoColors* colors = nullptr);

/// A flag per triangle: whether a camera sees it, or it belongs to what a camera sees. Those belong that
/// - lie in a gap: no more than kGapRings edges separate every vertex of the gap from vertices that are seen, so that
///   edges do not fray and creases stay closed;
/// - complete an object: their connected part is seen over all but kHiddenShare of its area.
std::vector<char> triangles_in_sight(const Surface& surface, std::span<const Sights> sights);
inline constexpr int kGapRings = 6;
inline constexpr double kHiddenShare = 0.1;

}  // namespace semfield
