// What is asked of a network apart from steps of training: rays to render and densities, on the stages of any device
// with host memory at both ends; the field at points of space, and its semantic part, which learns from points.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <type_traits>
#include <vector>

#include "compute/parallel.h"
#include "core/workspace.h"
#include "model/optim/adam.h"
#include "model/param_store.h"
#include "model/pass.h"
#include "model/stages.h"

namespace semfield {

template <class Real>
class Pipeline;

/// Rays to render and where results go, host memory; R rows each, empty = not wanted.
template <class Real>
struct RenderJob {
  View<const double> origin, direction, near_far;
  View<const std::int16_t> truth;      ///< true classes; only to fill truth_probability
  View<Real> color;                    ///< [R, 3]
  View<Real> depth;                    ///< [R, 1] metres along the ray, not divided by opacity
  View<Real> opacity;                  ///< [R, 1]
  View<std::int16_t> label;            ///< [R, 1] argmax class
  View<Real> entropy;                  ///< [R, 1] nats
  View<Real> confidence;               ///< [R, 1] largest class probability
  View<Real> truth_probability;        ///< [R, 1] of the true class; 0 where void
  View<Real> probability;              ///< [R, K] of each of the K logits, softmax of the composited ones
  View<OpacityResolution> resolution;  ///< [R, 1]
  ChannelTable<Real> heads;            ///< [R, C] each, by the channel of a head beside that of class logits
  double footprint_per_m = 0;          ///< width of a pixel at a distance of 1 m, metres; for `resolution`

  RenderJob rows(std::int64_t begin, std::int64_t count) const;
};

/// ctx.workspace holds everything of the walk; the caller's scope gives it back. per_ray: most samples per ray after
/// each pass. On a device results are there once its stream has been waited for.
template <class Real>
void render_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                 const RenderJob<Real>& job, const StepContext& ctx);

/// sigma [N, 1] of the pass at world positions [N, 3], host memory both.
template <class Real>
void query_density(const Pass<Real>& pass, View<const double> positions, View<Real> sigma, const StepContext& ctx);

/// Rows as bytes, as Stages::copy takes them.
template <class T>
auto bytes_of(View<T> rows) {
  using Byte = std::conditional_t<std::is_const_v<T>, const std::byte, std::byte>;
  return View<Byte>(reinterpret_cast<Byte*>(rows.data), rows.rows, rows.cols * static_cast<std::int32_t>(sizeof(T)),
                    rows.row_stride * static_cast<std::int64_t>(sizeof(T)), rows.device);
}

/// Host views of a call as the stages see them: themselves, or copies in the device's memory.
template <class Real>
struct HostEnds {
  const Stages<Real>& stages;
  Workspace& arena;

  template <class T>
  View<const T> sent(View<const T> from) const {
    if (from.empty() || stages.host_memory) return from;
    const View<T> to = arena.take<T>(from.rows, from.cols);
    stages.copy(bytes_of(from), bytes_of(to));
    return to;
  }
  template <class T>
  View<T> room_for(View<T> wanted) const {
    return wanted.empty() || stages.host_memory ? wanted : arena.take<T>(wanted.rows, wanted.cols);
  }
  template <class From, class T>
  void fetch(View<From> from, View<T> wanted) const {
    if (!wanted.empty() && wanted.data != from.data) stages.copy(bytes_of(View<const T>(from)), bytes_of(wanted));
  }
};

// The field at points of space, apart from rays: what it returns there, and the semantic part learned from points.

/// Points and where results go, host memory; N rows each, empty = not wanted.
template <class Real>
struct PointQuery {
  View<const double> position;   ///< [N, 3] world
  View<const double> direction;  ///< [N, 3] unit vectors that points are seen along; for `color` alone
  View<Real> sigma;              ///< [N, 1] density after activation, 1/m
  View<Real> color;              ///< [N, 3] in (0, 1)
  View<Real> logits;             ///< [N, K] of a sample of weight 1; only where the pipeline has semantics
};

/// Answers of the last pass, computed by the CPU from the pipeline's store, whatever its steps run on: where that
/// is a device, bring the store up to date first (Executor::download). The same bits for any grouping of points into
/// calls and any number of threads. Not beside another call.
template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query);

/// Steps of learning from points: which points each of them takes, and its update. Host memory.
template <class Real>
struct PointLessons {
  View<const Real> rows;                 ///< [N, dims] of PointNetwork::rows
  std::span<const std::int16_t> logit;   ///< [N]
  std::span<const std::int32_t> choice;  ///< [steps, batch] numbers of points
  std::int64_t batch = 0;
  std::span<const AdamStep> updates;  ///< [steps]
  double weight_decay = 0;            ///< of weights, not biases: fraction of a value times the learning rate
};

/// The semantic part of the last pass at points of space, where the executor's steps run. Semantic tensors are those of
/// its branch, if it has one, and of its head. Views are host memory. Only for pipelines with semantics, and not beside
/// another call of the executor.
template <class Real>
class PointNetwork {
 public:
  virtual ~PointNetwork() = default;
  /// What the network reads at world positions [N, 3] (Pass::point_rows); valid while the geometry stays.
  virtual void rows(View<const double> positions, View<Real> rows) = 0;
  /// logits [N, C] of points with these rows.
  virtual void logits(View<const Real> rows, View<Real> logits) = 0;
  /// Trains the semantic tensors, which begin as they lie in the store. Store and executor have them afterwards, with
  /// moments of zero. The pipeline must be trainable.
  virtual void learn(const PointLessons<Real>& lessons) = 0;
  /// Brings the semantic tensors of the store up to date, or takes them over from it, with their moments.
  virtual void read() = 0;
  virtual void write() = 0;
};

/// On the CPU, from the pipeline's store. The same bits for any number of threads.
template <class Real>
class LanePoints final : public PointNetwork<Real> {
 public:
  /// Borrows the pipeline.
  explicit LanePoints(Pipeline<Real>& pipeline) : pipeline_(pipeline) {}
  void rows(View<const double> positions, View<Real> rows) override;
  void logits(View<const Real> rows, View<Real> logits) override;
  void learn(const PointLessons<Real>& lessons) override;
  void read() override {}
  void write() override;

 private:
  void gradients(std::int64_t step, View<const Real> input, View<const std::int16_t> logit,
                 const std::vector<Tensor<Real>*>& tensors);
  StepContext context(std::int64_t step, bool training, Workspace& arena) const;
  const Pass<Real>& pass() const { return pipeline_.passes().back(); }

  Pipeline<Real>& pipeline_;
  ThreadArenas arenas_;
};

/// Those of the store that labels shape.
template <class Real>
std::vector<Tensor<Real>*> semantic_tensors(ParamStore<Real>& store);

}  // namespace semfield
