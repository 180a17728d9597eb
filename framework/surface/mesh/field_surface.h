// From a trained field to a surface: density on a grid, its level set, and what rendering shows of every vertex.
#pragma once

#include <functional>
#include <limits>
#include <span>
#include <vector>

#include "eval/evaluator.h"
#include "surface/mesh/marching_cubes.h"
#include "surface/mesh/sights.h"
#include "surface/surface_graph.h"

namespace semfield {

/// The density at which a cell's edge lets half of the light through: ln 2 / spacing, in 1/m.
double half_opaque_density(double spacing);

/// Where a surface is looked for, and at which density.
struct SurfaceRequest {
  VoxelGrid grid;
  double level_per_m = 0;
  /// Points on the grid's border are dense, whatever the field says: where rays end at the bounds and their last sample
  /// takes the rest (FarMode::background), rendering shows a wall there.
  bool opaque_border = false;
};

/// The level set of the density of the pipeline's last pass. Between points the opacity that the density gives a length
/// of ln 2 / level is interpolated, not the density itself: the same surface, but a wall of 1,000 / m does not draw it
/// to its empty neighbour. Triangles face the empty side; normals are set.
Surface density_surface(const Pipeline<float>& pipeline, const SurfaceRequest& request);

/// Class and entropy of the vertices, those of the surest of the cameras that see them, along the whole of their rays:
/// a field that was trained briefly is soft, and a part of a ray, within some cells of the surface, is a guess. What no
/// camera sees, or no ray meets: kVoid and the most entropy. Without semantics there are none.
PointAttributes render_attributes(Pipeline<float>& pipeline, const Surface& surface, std::span<const RayCamera> cameras,
                                  std::span<const Sights> sights, const RayLimits& limits,
                                  const ClassOfLogit& class_of_logit);

// Depth of many views fused into signed distances [Curless96]: a surface where cameras saw one, and none where none
// did.

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

/// The density whose first crossing along the views' rays lies nearest to where they put the surface: the mean
/// distance, at most eight cells per ray, is least among half_opaque_density(spacing) * 2^(-k/2), k = 0..18. A field
/// that was trained briefly is soft: one fixed level would lose its walls or inflate its objects.
double choose_level(const Pipeline<float>& pipeline, const SurfaceRequest& request, std::span<const DepthView> views,
                    const RayLimits& limits);

/// The surface that the views' depth agrees on. At a point of the grid each view whose pixel there shows something at
/// distance d, or farther, says d - r, r the point's own distance, cut off at kTruncationCells. A view whose surface
/// lies more than that before the point says nothing, and a pixel at an edge of depth says what is empty and no
/// more. The mean, weighted by 1 / r, is 0 on the surface. What no view speaks of is taken for solid. Triangles stay
/// where at least two views, or the only one that can see so far, put each corner within kAgreeCells of their depth,
/// across the surface. Normals are set.
///
/// `guessed`: nothing but photographs told the depth, and views that guess alike are few. Triangles stay where
/// kLeastGuesses views agree, and half of those that can see; slits of up to 2 * kSlitRings edges are filled, strips as
/// narrow are dropped, and the surface is smoothed.
Surface fused_surface(std::span<const DepthView> views, const RayLimits& limits, const VoxelGrid& grid,
                      bool guessed = false);
inline constexpr double kAgreeCells = 2;
inline constexpr int kLeastGuesses = 3, kSlitRings = 3;

}  // namespace semfield
