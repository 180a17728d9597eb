// The small network that says of a point of the surface which object it is of: learned from segments alone, in a phase
// of its own. Colour, density and semantics of the run do not move.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <vector>

#include "compute/parallel.h"
#include "core/small_math.h"
#include "labels/segments.h"
#include "model/param_store.h"
#include "plugin/grouping.h"
#include "plugin/mlp/mlp.h"
#include "surface/surface_graph.h"
#include "train/session.h"

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

struct ObjectNetworkShape {
  std::int64_t frequencies = 7;
  std::int64_t hidden_width = 64;
  std::int64_t hidden_layers = 2;
};

struct ObjectLearning {
  std::int64_t steps = 2000;
  std::int64_t views = 8;          ///< of a step
  std::int64_t view_points = 256;  ///< of each
  double learning_rate = 5e-3;     ///< falls to a hundredth along half a cosine
  std::uint64_t seed = 1;
};

/// Position in the scene's box, then its sines and cosines [Mildenhall20 Eq. 4], and layers with ReLU.
template <class Real>
class ObjectNetwork {
 public:
  /// Borrows the tables and the grouping, whose outputs these are. `box`: of the scene; its longest side becomes [-1,
  /// 1].
  ObjectNetwork(const KernelTables& kernels, const Grouping& grouping, const ObjectNetworkShape& shape, const Box& box,
                std::uint64_t seed, std::int64_t views);

  /// Learns the grouping from sights of the points at `positions`. A step draws views, of each its segments by the root
  /// of their size, and points of them, at addresses (seed, step, "objects/..."). The same bits for any number of
  /// threads.
  void learn(std::span<const Vec3d> positions, std::span<const SegmentSights> sights, const ObjectLearning& learning,
             const ObjectProgress& progress);
  /// The same on a GPU, from the same draws: another order of sums, the same bits each time. False, and nothing is
  /// done, where the grouping has no kernels there.
  bool learn_on_gpu(int ordinal, std::span<const Vec3d> positions, std::span<const SegmentSights> sights,
                    const ObjectLearning& learning, const ObjectProgress& progress);
  /// The loss of one step, and its gradients in the store; for tests.
  double gradients(std::span<const Vec3d> positions, std::span<const SegmentSights> sights,
                   const ObjectLearning& learning, std::int64_t step);

  /// Outputs [N, width], points in parallel.
  std::vector<Real> outputs(std::span<const Vec3d> positions);
  ParamStore<Real>& store() { return store_; }

 private:
  std::int32_t input_dims() const { return static_cast<std::int32_t>(3 + 6 * shape_.frequencies); }
  void encode(Vec3d position, Real* row) const;
  std::vector<Real> encoded(std::span<const Vec3d> positions);
  double view_gradients(View<const Real> points, const SegmentSights& view, const ObjectLearning& learning,
                        std::int64_t step, std::int64_t number, Workspace& arena);
  double step_gradients(View<const Real> points, std::span<const SegmentSights* const> seen,
                        const ObjectLearning& learning, std::int64_t step);
  void follow(double share);

  const KernelTables& kernels_;
  const Grouping& grouping_;
  ObjectNetworkShape shape_;
  Vec3d middle_;
  double half_m_;
  std::unique_ptr<Mlp<Real>> net_;
  ParamStore<Real> store_, slow_;
  int component_, slow_component_;
  ThreadArenas arenas_;
};

extern template class ObjectNetwork<float>;
extern template class ObjectNetwork<double>;

}  // namespace semfield
