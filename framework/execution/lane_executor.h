// Steps and rendering on the CPU: a batch is cut into tiles, lanes take them in parallel, and their gradients are
// summed in a fixed order.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "compute/parallel.h"
#include "core/workspace.h"
#include "execution/pipeline.h"
#include "execution/ranks_executor.h"
#include "execution/train_rays.h"
#include "model/param_store.h"
#include "model/stages.h"

namespace semfield {

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
  void render(const RenderJob<Real>& job) override;
  void density(View<const double> positions, View<Real> sigma) override;
  PointNetwork<Real>& points() override { return points_; }

  /// Losses of the batch and dL/dtheta in the store's main gradients; those of sparse tensors must be zero on entry. A
  /// value of a ray that is not finite throws RayFault; gradients are then anything, and ParamStore::clear_gradients is
  /// due.
  StepLosses gradients(std::int64_t step, const RayBatch& batch);
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
  LanePoints<Real> points_;
  std::optional<LaneRanks<Real>> ranks_;
  std::vector<StepLosses> queued_, done_;  // made since the last finish(), and before it
  std::optional<Error> afterwards_;
};

}  // namespace semfield
