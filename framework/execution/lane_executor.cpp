#include "execution/lane_executor.h"

#include <algorithm>
#include <functional>
#include <numeric>
#include <utility>

#include "compute/float_mode.h"
#include "compute/isa.h"
#include "losses/photometric.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {
constexpr std::int64_t kRoundRows = 512;  // samples of a round of rendering

// Any sample whose density, and with it the slope of its activation, is not 0.
template <class Real>
bool any_density(const PassTrace<Real>& trace) {
  const Real* const sigma = trace.sigma.data;
  return std::any_of(sigma, sigma + trace.samples.count, [](Real density) { return density > 0; });
}

}  // namespace

template <class Real>
LaneExecutor<Real>::LaneExecutor(Pipeline<Real>& pipeline)
    : pipeline_(pipeline),
      inboxes_(static_cast<std::size_t>(options().lanes), std::vector<EncoderInbox<Real>>(passes().size())),
      points_(pipeline) {
  lane_order_.reserve(inboxes_.size());
  queued_.reserve(1);  // they change places in every step, which so allocates nothing from the first on
  done_.reserve(1);
}

template <class Real>
StepContext LaneExecutor<Real>::context(std::int64_t step, bool training, std::int64_t first_ray,
                                        Workspace& arena) const {
  StepContext ctx;
  ctx.seed = options().seed;
  ctx.step = step;
  ctx.training = training;
  ctx.first_ray = first_ray;
  ctx.workspace = &arena;
  return ctx;
}

template <class Real>
std::string LaneExecutor<Real>::matrix_products() const {
  return std::string(isa_name(isa()));
}

template <class Real>
auto LaneExecutor<Real>::tile_of(std::int64_t number, std::int64_t rays) const -> TileRange {
  const std::int64_t tile_rays = pipeline_.tile_rays(), begin = number * tile_rays;
  return {begin, std::min(tile_rays, rays - begin), number};
}

// Lanes with a tile more than others have the low numbers.
template <class Real>
void LaneExecutor<Real>::order_lanes(std::int64_t tiles) {
  const std::int64_t with_tiles = std::min<std::int64_t>(end_lane(), tiles) - first_lane();
  lane_order_.resize(static_cast<std::size_t>(std::max<std::int64_t>(0, with_tiles)));
  std::iota(lane_order_.begin(), lane_order_.end(), first_lane());
  if (!draws_ahead()) return;
  std::sort(lane_order_.begin(), lane_order_.end(), [&](int a, int b) {
    const std::int64_t of_a = ahead_.lane_rows(a), of_b = ahead_.lane_rows(b);
    return of_a != of_b ? of_a > of_b : a < b;
  });
}

template <class Real>
void LaneExecutor<Real>::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  const WorkScope scope(options().work);
  const ComputeFloatMode mode;
  const StepLosses losses = checked_gradients(step, batch);
  AdamStep rule = update;
  rule.labelled = losses.labelled > 0;
  passes().front().parts().stages->adam(&rule, pipeline_.store().learned());
  queued_.push_back(losses);
  pipeline_.derive(step + 1);
  try {
    observe(step + 1);
  } catch (const Error& error) {
    afterwards_ = error;
  }
}

template <class Real>
StepResults LaneExecutor<Real>::finish() {
  done_.swap(queued_);
  queued_.clear();
  return {done_, {}, std::exchange(afterwards_, std::nullopt)};
}

template <class Real>
void LaneExecutor<Real>::observe(std::int64_t step) {
  StepContext ctx = context(step, true);
  for (const Pass<Real>& pass : passes()) {
    ctx.pass = pass.parts().number;
    const auto query = [&](View<const double> positions, View<Real> sigma) { ask(pass, ctx, positions, sigma); };
    pass.observe(ctx, std::cref(query));  // by reference, which allocates nothing
  }
}

// The density at each position does not depend on the others, so that threads and processes may share them.
template <class Real>
void LaneExecutor<Real>::ask(const Pass<Real>& pass, const StepContext& ctx, View<const double> positions,
                             View<Real> sigma) {
  constexpr std::int64_t kPiece = 4096;
  const auto answer = [&](std::int64_t begin, std::int64_t end) {
    parallel_for((end - begin + kPiece - 1) / kPiece, [&](std::int64_t i) {
      StepContext local = ctx;
      const WorkspacePool::Loan arena(queries_);
      local.workspace = arena.get();
      const std::int64_t first = begin + i * kPiece, count = std::min(kPiece, end - first);
      pass.density(local, positions.row_range(first, count), sigma.row_range(first, count));
    });
  };
  // A sampler that asks from several threads asks each process in another order.
  if (!ranks_ || inside_parallel()) return answer(0, positions.rows);
  try {
    ranks_->share_rows(sigma, answer);
  } catch (const RankLost&) {  // the step is made but for this; the next one finds out
    answer(0, positions.rows);
  }
}

template <class Real>
StepLosses LaneExecutor<Real>::gradients(std::int64_t step, const RayBatch& batch) {
  const WorkScope scope(options().work);
  const ComputeFloatMode mode;
  const std::int64_t rays = batch.origin.rows, tile_rays = pipeline_.tile_rays();
  const std::int64_t tiles = (rays + tile_rays - 1) / tile_rays;
  guard_rays<Real>({batch.origin, batch.direction, batch.near_far}, batch.targets.color, 0);
  const BatchScales scales = pipeline_.scales_of(batch);
  const RayBatch seen = moved(batch);
  if (ranks_) {
    ranks_->share_out(tiles);
    agree(ranks_->all(), [&] { walk_tiles(step, seen, tiles, scales); });
    ranks_->gather_losses(tile_losses_);
  } else {
    walk_tiles(step, seen, tiles, scales);
  }
  scatter(step);
  if (ranks_) {
    ranks_->sum_lanes(pipeline_.store());
  } else {
    pipeline_.store().reduce_lanes();
  }
  StepContext ctx = context(step, true);
  for (const Pass<Real>& pass : passes()) {
    ctx.pass = pass.parts().number;
    pass.derive_backward(ctx);
  }
  if (pipeline_.cameras() != nullptr) pipeline_.cameras()->derive_backward(ctx);
  StepLosses sum;
  for (const StepLosses& tile : tile_losses_) {  // tile order: the same sum for any thread count
    sum.color += tile.color;
    sum.semantic += tile.semantic;
    sum.mse += tile.mse;
    for (std::size_t i = 0; i < options().losses.entries().size(); ++i) sum.terms[i] += tile.terms[i];
    sum.samples += tile.samples;
    sum.labelled += tile.labelled;
    sum.correct += tile.correct;
    sum.dense_passes |= tile.dense_passes;
  }
  return pipeline_.means_of(sum, scales);
}

// The batch with rays as their cameras are corrected.
template <class Real>
RayBatch LaneExecutor<Real>::moved(const RayBatch& batch) {
  const CameraCorrections<Real>* const cameras = pipeline_.cameras();
  if (cameras == nullptr || !cameras->rules().poses) return batch;
  const auto copy = [](View<const double> from, std::vector<double>& to) {
    to.resize(static_cast<std::size_t>(from.size()));
    for (std::int64_t r = 0; r < from.rows; ++r) std::copy_n(from.row(r), from.cols, to.data() + r * from.cols);
    return View<double>(to.data(), from.rows, from.cols);
  };
  const View<double> origin = copy(batch.origin, moved_origin_), direction = copy(batch.direction, moved_direction_);
  cameras->move(batch.targets.more[channel::camera], origin, direction);
  RayBatch seen = batch;
  seen.origin = origin;
  seen.direction = direction;
  return seen;
}

template <class Real>
void LaneExecutor<Real>::walk_tiles(std::int64_t step, const RayBatch& batch, std::int64_t tiles,
                                    const BatchScales& scales) {
  tile_losses_.assign(static_cast<std::size_t>(tiles), StepLosses{});
  for (auto& lane : inboxes_) {
    for (EncoderInbox<Real>& inbox : lane) inbox.rows = 0;
  }
  if (draws_ahead()) draw_ahead(step, batch, tiles);
  order_lanes(tiles);
  arenas_.for_units(std::ssize(lane_order_), [&](Workspace& arena, std::int64_t i) {
    const int lane = lane_order_[static_cast<std::size_t>(i)];
    for (std::int64_t tile = lane; tile < tiles; tile += options().lanes) {
      const TileRange range = tile_of(tile, batch.origin.rows);
      tile_losses_[static_cast<std::size_t>(tile)] =
          train_tile(context(step, true, range.begin, arena), lane, batch, range, scales);
    }
  });
}

// A tile on the CPU: sums are the tile's, gradients at encoders are collected for the scatter of whole lanes.
template <class Real>
class LaneExecutor<Real>::TileExecutor final : public StepExecutor<Real> {
 public:
  TileExecutor(LaneExecutor& owner, int lane, const TileRange& tile, const BatchScales& scales)
      : owner_(owner), lane_(lane), tile_(tile), scales_(scales) {}

  StepLosses sums;

  const SampledTile<Real>* drawn() const override {
    const bool drawn = owner_.draws_ahead() && tile_.number != kAlone;
    return drawn ? &owner_.ahead_.tiles[static_cast<std::size_t>(tile_.number)] : nullptr;
  }
  void color_loss(std::size_t, Workspace&, View<const Real> color, View<const float> target,
                  View<Real> d_color) override {
    sums.mse = photometric_loss<Real>(color, target, scales_.color, 1.0, d_color);
    sums.color += sums.mse;
  }
  void semantic_loss(std::size_t, Workspace&, View<const Real> logits, const SemanticTargets& targets,
                     View<Real> d_logits) override {
    const PipelineOptions& options = owner_.options();
    const auto classes = static_cast<std::int32_t>(options.class_weight.size());
    const View<const float> class_weight =
        classes == 0 ? View<const float>() : View<const float>(options.class_weight.data(), 1, classes);
    const SemanticLoss semantic = semantic_cross_entropy<Real>(logits, targets, class_weight, scales_.semantic,
                                                               options.rules.semantics.weight, d_logits, tile_.begin);
    sums.semantic += semantic.sum;
    sums.labelled = semantic.labelled;
    sums.correct = semantic.correct;
  }
  const LossList& losses() const override { return owner_.options().losses; }
  std::uint32_t active_losses() const override { return scales_.terms.active; }
  void add_losses(std::size_t, Workspace&, std::uint32_t which, const RayTargets& targets,
                  const RayValues<Real>& values, const RayGradients<Real>& gradients) override {
    losses().template add<Real>(which, scales_.terms, targets, values, gradients, sums.terms);
  }
  void count(std::size_t pass, const PassTrace<Real>& trace) override {
    sums.samples = trace.samples.count;
    if (any_density(trace)) sums.dense_passes |= 1U << pass;
  }
  View<Real> encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, Workspace& arena) override {
    const std::int32_t dims = trace.encoded.cols;
    if (tile_.number == kAlone) return arena.take<Real>(trace.samples.count, dims);
    Ahead& ahead = owner_.ahead_;
    if (drawn() == nullptr) return owner_.inboxes_[static_cast<std::size_t>(lane_)][pass].append(trace.x, dims);
    const std::int64_t row = ahead.row[static_cast<std::size_t>(tile_.number)];
    return {ahead.d_encoded.data() + dims * row, trace.samples.count, dims};
  }
  void use_encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, const StepContext&,
                            View<Real> d_encoded) override {
    if (tile_.number != kAlone) return;
    RayGuard<Real>(owner_.passes()[pass].parts().name, tile_.begin, trace.samples)
        .per_sample("gradient of the encoded position", d_encoded);
  }

 private:
  LaneExecutor& owner_;
  int lane_;
  TileRange tile_;
  const BatchScales& scales_;
};

template <class Real>
StepLosses LaneExecutor<Real>::train_tile(const StepContext& ctx, int lane, const RayBatch& batch,
                                          const TileRange& tile, const BatchScales& scales) {
  const std::int64_t begin = tile.begin, count = tile.count;
  const Workspace::Scope tile_scope(*ctx.workspace);
  TrainedRays<Real> rays;
  rays.lane = lane;
  rays.cameras = pipeline_.cameras();
  rays.batch = batch.rows(begin, count);
  const View<const std::int16_t> label = rays.batch.targets.label;
  for (std::int64_t r = 0; r < label.rows && pipeline_.has_semantics(); ++r) {
    if (options().head_on_all_rays || label(r, 0) != kVoid) rays.semantic_rays = r + 1;
  }
  rays.first_color = rays.batch.without_color();
  TileExecutor executor(*this, lane, tile, scales);
  train_rays<Real>(passes(), pipeline_.per_ray(), rays, ctx, executor);
  return executor.sums;
}

template <class Real>
void LaneExecutor<Real>::render(const RenderJob<Real>& job) {
  const WorkScope scope(options().work);
  guard_rays<Real>({job.origin, job.direction, job.near_far}, {}, 0);
  // Where rays stop early their samples come in rounds, and a round of so few rays would leave kernels half empty.
  const bool rounds = passes().size() == 1 && options().rules.rendering.early_stop > 0;
  const std::int64_t rays = job.origin.rows;
  const std::int64_t unit = std::max(pipeline_.tile_rays(), rounds ? kRoundRows / kRoundSamples : 1);
  arenas_.for_units((rays + unit - 1) / unit, [&](Workspace& arena, std::int64_t number) {
    const std::int64_t begin = number * unit;
    const Workspace::Scope scratch(arena);
    render_rays(passes(), pipeline_.per_ray(), job.rows(begin, std::min(unit, rays - begin)),
                context(0, false, begin, arena));
  });
}

template <class Real>
void LaneExecutor<Real>::density(View<const double> positions, View<Real> sigma) {
  const WorkScope scope(options().work);
  const std::int64_t batch = passes().back().parts().stages->density_batch;
  arenas_.for_units((positions.rows + batch - 1) / batch, [&](Workspace& arena, std::int64_t i) {
    const std::int64_t begin = i * batch, count = std::min(batch, positions.rows - begin);
    query_density(passes().back(), positions.row_range(begin, count), sigma.row_range(begin, count),
                  context(0, false, 0, arena));
  });
}

template <class Real>
std::size_t LaneExecutor<Real>::workspace_bytes() const {
  std::size_t sum = ahead_.bytes() + arenas_.bytes();
  for (const auto& lane : inboxes_) {
    for (const EncoderInbox<Real>& inbox : lane)
      sum += inbox.x.capacity() * sizeof(double) + inbox.dy.capacity() * sizeof(Real);
  }
  return sum;
}

template <class Real>
std::int64_t LaneExecutor<Real>::workspace_growths() const {
  return arenas_.growths();
}

template class LaneExecutor<float>;
template class LaneExecutor<double>;

}  // namespace semfield
