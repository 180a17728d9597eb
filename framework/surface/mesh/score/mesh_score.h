// How much of what depth images show a mesh has, and how near it lies to what they show.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "scene/scene.h"
#include "surface/mesh/field_surface.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// A triangle may have corners that are the same, so a set of points is one of triangles {i, i, i}.
class NearestSurface {
 public:
  NearestSurface(std::vector<Vec3d> positions, std::vector<Triangle> triangles);
  explicit NearestSurface(std::vector<Vec3d> points);

  /// To the nearest point of any triangle, in units of the world; `most` where none is nearer. From any thread.
  double distance(Vec3d point, double most) const;

 private:
  struct Node {
    Box box;
    std::uint32_t first = 0, end = 0;  // its triangles
    std::uint32_t second = 0;          // number of the second child, the first follows the node; 0: a leaf
  };
  std::uint32_t build(std::uint32_t first, std::uint32_t end);
  Vec3d middle(const Triangle& t) const { return (positions_[t[0]] + positions_[t[1]] + positions_[t[2]]) * (1.0 / 3); }

  std::vector<Vec3d> positions_;
  std::vector<Triangle> triangles_;  // those of a node lie side by side
  std::vector<Node> nodes_;
};

/// A depth image as a view: distances along the rays, in the unit of the scene; where the image has no value nothing is
/// known. The map has the size of the camera's image.
DepthView measured_view(const RayCamera& camera, const DepthMap& depth);

/// Distances that a score counts within, ascending, in metres of usual_metre().
inline constexpr std::array<double, 3> kScoreDistances{0.02, 0.05, 0.10};
using ScoreShares = std::array<double, kScoreDistances.size()>;  ///< 0..1, for each of kScoreDistances

struct MeshScore {
  ScoreShares complete{};                           ///< of the points of all depth images, those so near to the mesh
  std::optional<ScoreShares> complete_of_held_out;  ///< the same of held-out frames alone; none without any
  ScoreShares accurate{};                           ///< of the points of the mesh that are judged
  ScoreShares f{};                                  ///< harmonic mean of `complete` and `accurate`
  double judged = 0;                                ///< share of the mesh that depth images speak of
};

/// Depth images of a scene as what meshes are compared with [Knapitsch17]: completeness is their recall,
/// accuracy their precision. We differ: distances are taken to triangles of the mesh, and what no depth image speaks of
/// is left out of accuracy, as [Schops17] do with laser scans.
///
/// - Points of depth images are thinned to one per cube of kPointCube metres, so that what many frames show counts
/// once.
/// - kMeshPoints points of the mesh are drawn evenly by area, addressed by their number. A point is judged where some
///   depth image has a value at its pixel and the point lies no farther than kScoreDistances.back() behind it. What
///   lies behind everything that was measured is neither right nor wrong.
class DepthReference {
 public:
  /// Views of measured_view; `metre` in units of the scene (usual_metre). Memory: about 130 bytes per cube of
  /// kPointCube that the images show.
  DepthReference(std::span<const DepthView> of_training, std::span<const DepthView> held_out, double metre = 1);

  /// Points after thinning: of all frames, and of those that are held out.
  std::size_t points() const { return points_.size(); }
  std::size_t held_out_points() const { return held_out_.size(); }
  MeshScore score(const Surface& surface) const;

 private:
  bool judges(Vec3d point) const;

  double metre_;
  std::span<const DepthView> training_views_, held_out_views_;
  std::vector<Vec3d> points_, held_out_;
  NearestSurface measured_;  // all points
};
inline constexpr double kPointCube = 0.01;
inline constexpr std::int64_t kMeshPoints = 200'000;

}  // namespace semfield
