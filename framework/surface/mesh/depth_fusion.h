// Depth of many views fused into signed distances [Curless96]: a surface where cameras saw one, and none where none
// did.
#pragma once

#include <functional>
#include <limits>
#include <span>
#include <vector>

#include "surface/mesh/marching_cubes.h"
#include "surface/surface_map.h"

namespace semfield {

/// Signed distances are cut off this many cells from a surface. What is thinner than that and seen from both sides is
/// pushed apart.
inline constexpr double kTruncationCells = 4;

/// A camera, and where rendering or a sensor puts the surface along its rays.
struct DepthView {
  RayCamera camera;
  SurfaceMap map;  ///< 0: the ray meets nothing, and what lies along it is empty; kNotKnown: it says nothing
};
inline constexpr float kNotKnown = std::numeric_limits<float>::quiet_NaN();

/// Every view's depth, with about `rays` rays for all of them. `done`: views of all, after each.
std::vector<DepthView> depth_views(Pipeline<float>& pipeline, std::span<const RayCamera> cameras,
                                   const RayLimits& limits, std::int64_t rays,
                                   const std::function<void(std::size_t)>& done = {});

/// The surface that the views' depth agrees on. At a point of the grid each view whose pixel there shows something at
/// distance d, or farther, says d - r, r the point's own distance, cut off at kTruncationCells. A view whose surface
/// lies more than that before the point says nothing, and a pixel at an edge of depth says what is empty and no
/// more. The mean, weighted by 1 / r, is 0 on the surface. What no view speaks of is taken for solid. Triangles stay
/// where at least two views, or the only one that can see so far, put each corner within kAgreeCells of their depth,
/// across the surface. Normals are set.
Surface fused_surface(std::span<const DepthView> views, const RayLimits& limits, const VoxelGrid& grid);
inline constexpr double kAgreeCells = 2;

}  // namespace semfield
