// Rays against a triangle mesh; raycast.cpp is the only user of Embree.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>

#include "datasets/obj_room/mesh_io.h"

namespace semfield {

/// Nearest surface along a ray.
struct RayHit {
  std::int64_t triangle = -1;  ///< -1 = nothing hit
  double distance_m = 0;       ///< along the unit direction, from the triangle's plane in float64
  float b1 = 0, b2 = 0;        ///< barycentric weights of corners 1 and 2

  bool hit() const { return triangle >= 0; }
};

/// False where a surface lets rays through: (triangle, b1, b2).
using OpaqueTest = std::function<bool(std::int64_t, float, float)>;

/// Whether this build can cast rays (SEMFIELD_WITH_RAYCAST).
bool raycast_available();

/// Ray queries, const and callable from any thread. Keeps its own copy of nothing: the mesh must outlive it.
class Raycaster {
 public:
  /// `cut_out` has one element a triangle (true: ask `opaque` at every hit) or is empty. Throws Error(unavailable) in a
  /// build without Embree.
  explicit Raycaster(const TriangleMesh& mesh, std::vector<bool> cut_out = {}, OpaqueTest opaque = {});
  ~Raycaster();
  Raycaster(const Raycaster&) = delete;
  Raycaster& operator=(const Raycaster&) = delete;

  /// Nearest hit of origin + t * direction with t in (0, max_m]; direction has unit length.
  RayHit trace(Vec3d origin, Vec3d direction, double max_m = 1e6) const;
  /// Whether anything opaque lies on origin + t * direction, t in [0, max_m].
  bool blocked(Vec3d origin, Vec3d direction, double max_m) const;
  /// Distance from a point to the nearest triangle, at most `limit_m` (returned when nothing is nearer). Exact, any
  /// direction.
  double clearance(Vec3d point, double limit_m) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semfield
