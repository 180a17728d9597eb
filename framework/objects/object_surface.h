// Points of the surface that the training views of a run show, and which segments of which views they lie in.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "objects/segments.h"
#include "session/session.h"
#include "surface/surface_pool.h"

namespace semfield {

/// Called with what is done of all; may be null.
using ObjectProgress = std::function<void(double done, double of)>;

/// The training frames of a run with their surface maps, and one point per cell of the surface.
struct ObjectSurface {
  std::vector<PoolView> views;
  SurfacePool pool;
};

/// The training frames with their surface maps, of `rays` rays all together.
std::vector<PoolView> object_views(Session& session, std::int64_t rays, const ObjectProgress& progress);

/// Of about `points` points. Throws Error(data) where no ray meets anything.
ObjectSurface object_surface(std::vector<PoolView> views, const RayLimits& limits, std::int64_t points);

/// Of one view: places of its map that show a point of the pool in a segment, ordered by segment.
struct SegmentSights {
  std::vector<std::int32_t> point;     ///< numbers of SurfacePool::points
  std::vector<std::int32_t> segment;   ///< [as point] 0 .. segments - 1
  std::vector<std::int32_t> first;     ///< [segments + 1]: places of a segment in `point`
  std::vector<std::int16_t> class_of;  ///< [segments] class index, kVoid: not known

  std::int32_t segments() const { return static_cast<std::int32_t>(std::ssize(class_of)); }
};

/// An entry per view. Segments of fewer than `least` places are left out.
std::vector<SegmentSights> segment_sights(const ObjectSurface& surface, const SegmentSet& segments, std::int64_t least);
/// Segments that the points themselves are of: `id` [points], 0: none. Their classes are not known.
std::vector<SegmentSights> point_sights(const ObjectSurface& surface, std::span<const std::int32_t> id);

}  // namespace semfield
