// Steps and rendering on the CPU: a batch is cut into tiles, lanes take them in parallel, and their gradients are
// summed in a fixed order.
#pragma once

#include <cstddef>
#include <functional>
#include <optional>
#include <span>
#include <type_traits>
#include <vector>

#include "core/workspace.h"
#include "execution/pipeline.h"
#include "execution/ranks_executor.h"
#include "execution/thread_arenas.h"
#include "execution/train_rays.h"
#include "model/param_store.h"
#include "model/stages.h"

namespace semfield {

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

template <class Real>
class LaneExecutor final : public Executor<Real> {
 public:
  /// Borrows the pipeline, whose store is complete.
  explicit LaneExecutor(Pipeline<Real>& pipeline);

  DeviceId device() const override { return {}; }
  std::string description() const override { return "cpu"; }
  std::string matrix_products() const override;
  void upload(std::int64_t step) override { pipeline_.derive(step); }
  void download(std::int64_t) override {}
  std::int64_t tile_rays(std::int64_t) const override { return pipeline_.tile_rays(); }
  /// Throws what stopped the step, with the ray or the tensor and element behind it.
  void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) override;
  int most_queued() const override { return 1; }
  StepResults finish() override;
  void set_gradient_hook(GradientHook<Real> hook) override { hook_ = std::move(hook); }
  void render(const RenderJob<Real>& job) override;
  void density(View<const double> positions, View<Real> sigma) override;
  PointNetwork<Real>& points() override { return points_; }

  /// Losses of the batch and dL/dtheta in the store's main gradients (which must be zero on entry). A value of a ray
  /// that is not finite throws RayFault; gradients are then anything, and ParamStore::clear_gradients is due.
  StepLosses gradients(std::int64_t step, const RayBatch& batch);
  /// The same for gradients of any kind on entry, and throws Error for a number from which no update may start: a
  /// value, gradient or moment of a learned tensor, the loss, a derived or state tensor.
  StepLosses checked_gradients(std::int64_t step, const RayBatch& batch);
  /// After a step that failed: takes its rays one by one and gives the first that throws, or whose own gradient is not
  /// finite, with its number in the batch; none when only their sum fails. Leaves every gradient zero.
  std::optional<RayFault> find_fault(std::int64_t step, const RayBatch& batch);

  /// From the next step on the lanes are shared with the other processes of a run, all of which make every step with
  /// the same batch: each has a range of lanes, and all end with the bits of one process. Before the first step.
  void share_with(Ranks& ranks) { ranks_.emplace(ranks, options().lanes); }

  /// For calls in this thread alone.
  StepContext context(std::int64_t step, bool training) { return context(step, training, 0, arenas_.own()); }
  /// Scratch memory: high-water marks of all threads, and how often it grew.
  std::size_t workspace_bytes() const;
  std::int64_t workspace_growths() const { return arenas_.growths(); }

 private:
  // A step's samples drawn before the first is evaluated, all rows of a lane's tiles side by side: tables of an encoder
  // are then read, and written, for thousands of rows at a time, level by level, and not for one small tile after the
  // other. Vectors only grow.
  struct Ahead {
    std::vector<Real> t, delta;                      // [tiles * capacity of a tile]
    std::vector<std::int32_t> ray_of_sample, first;  // [tiles * capacity], [tiles * (tile_rays + 1)]
    std::vector<SampledTile<Real>> tiles;            // [tiles]
    std::vector<std::int64_t> row;                   // [tiles] of its first sample in what follows
    std::vector<double> x;                           // [M, 3]
    std::vector<Real> encoded, d_encoded;            // [M, Dp]
    std::vector<std::int64_t> lane_begin;            // [lanes + 1] rows of a lane's tiles, side by side
    std::int64_t rows = 0;
    std::int64_t lane_rows(int lane) const {
      return lane_begin[static_cast<std::size_t>(lane) + 1] - lane_begin[static_cast<std::size_t>(lane)];
    }
    std::size_t bytes() const;
  };
  static constexpr std::int64_t kAlone = -1;  // a tile's number: rays that are no tile of the step
  struct TileRange {
    std::int64_t begin, count, number;
  };
  class TileExecutor;
  const std::vector<Pass<Real>>& passes() const { return pipeline_.passes(); }
  const PipelineOptions& options() const { return pipeline_.options(); }
  bool draws_ahead() const { return passes().size() == 1 && passes()[0].scatters(); }
  StepContext context(std::int64_t step, bool training, std::int64_t first_ray, Workspace& arena) const;
  /// Lanes of this process.
  int first_lane() const { return ranks_ ? ranks_->first() : 0; }
  int end_lane() const { return ranks_ ? ranks_->end() : options().lanes; }
  bool is_own(std::int64_t tile) const {
    const std::int64_t lane = tile % options().lanes;
    return lane >= first_lane() && lane < end_lane();
  }
  RayBatch moved(const RayBatch& batch);
  /// Forward and backward of this process's tiles.
  void walk_tiles(std::int64_t step, const RayBatch& batch, std::int64_t tiles, const BatchScales& scales);
  void draw_ahead(std::int64_t step, const RayBatch& batch, std::int64_t tiles);
  void scatter(std::int64_t step);
  void gather(std::size_t pass);
  void observe(std::int64_t step);
  void ask(const Pass<Real>& pass, const StepContext& ctx, View<const double> positions, View<Real> sigma);
  StepLosses train_tile(const StepContext& ctx, int lane, const RayBatch& batch, const TileRange& tile,
                        const BatchScales& scales);

  Pipeline<Real>& pipeline_;
  ThreadArenas arenas_;
  std::vector<std::vector<EncoderInbox<Real>>> inboxes_;  // of a lane, one a pass
  std::vector<int> lane_order_;
  std::vector<StepLosses> tile_losses_;
  std::vector<double> moved_origin_, moved_direction_;
  Ahead ahead_;
  WorkspacePool queries_;
  LanePoints<Real> points_;
  std::optional<LaneRanks<Real>> ranks_;
  GradientHook<Real> hook_;
  std::vector<StepLosses> queued_, done_;  // made since the last finish(), and before it
  std::optional<Error> afterwards_;
};

// Host memory at both ends of a call on a device.

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

}  // namespace semfield
