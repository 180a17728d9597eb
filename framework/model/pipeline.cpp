#include "model/pipeline.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "compute/float_mode.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "losses/photometric.h"
#include "model/device_backend.h"
#include "model/network_plan.h"

namespace semfield {

namespace {
template <class T>
View<const T> rows_of(View<const T> view, std::int64_t begin, std::int64_t count) {
  return view.empty() ? view : view.row_range(begin, count);
}

// Any sample whose density, and with it the slope of its activation, is not 0.
template <class Real>
bool any_density(const PassTrace<Real>& trace) {
  const Real* const sigma = trace.sigma.data;
  return std::any_of(sigma, sigma + trace.samples.count, [](Real density) { return density > 0; });
}

}  // namespace

std::int64_t label_only_rays(double share, std::int64_t begin, std::int64_t end) {
  return static_cast<std::int64_t>(std::floor(static_cast<double>(end) * share)) -
         static_cast<std::int64_t>(std::floor(static_cast<double>(begin) * share));
}

double color_normaliser(const RayBatch& batch) {
  const std::int64_t rays = batch.origin.rows - label_only_rays(batch.label_only_share, 0, batch.origin.rows);
  return static_cast<double>(std::max<std::int64_t>(1, 3 * rays));
}

RayTargets targets_of(const RayBatch& batch) { return {batch.target, batch.label, batch.soft, batch.depth}; }

template <class Real>
Pipeline<Real>::Pipeline(std::vector<PassParts<Real>> passes, PipelineOptions options, bool trainable)
    : options_(std::move(options)), store_(options_.seed, options_.lanes, trainable) {
  SEMFIELD_CHECK(!passes.empty(), "a pipeline needs a pass");
  std::vector<const PassParts<Real>*> parts_of;
  passes_.reserve(passes.size());
  for (PassParts<Real>& parts : passes) {
    passes_.emplace_back(std::move(parts), options_.rules, store_);
    parts_of.push_back(&passes_.back().parts());
  }
  tile_rays_ = tile_rays_of(parts_of, options_, per_ray_);
  for (int lane = 0; lane < options_.lanes; ++lane) {
    lanes_.push_back(std::make_unique<Lane>());
    lanes_.back()->inbox.resize(passes_.size());
  }
  derive(0);
}

template <class Real>
StepContext Pipeline<Real>::context(std::int64_t step, bool training, int lane, std::int64_t first_ray) const {
  StepContext ctx;
  ctx.seed = options_.seed;
  ctx.step = step;
  ctx.training = training;
  ctx.first_ray = first_ray;
  ctx.workspace = &lanes_[static_cast<std::size_t>(lane)]->arena;
  return ctx;
}

template <class Real>
void Pipeline<Real>::derive(std::int64_t step) {
  const WorkScope scope(options_.work);
  const ComputeFloatMode mode;
  StepContext ctx = context(step, false, 0, 0);
  for (const Pass<Real>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.derive(ctx);
  }
}

template <class Real>
void Pipeline<Real>::observe(std::int64_t step) {
  const WorkScope scope(options_.work);
  const ComputeFloatMode mode;
  StepContext ctx = context(step, true, 0, 0);
  for (const Pass<Real>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.observe(ctx);
  }
}

template <class Real>
StepLosses Pipeline<Real>::gradients(std::int64_t step, const RayBatch& batch) {
  const WorkScope scope(options_.work);
  const ComputeFloatMode mode;
  const std::int64_t rays = batch.origin.rows;
  const std::int64_t tiles = (rays + tile_rays_ - 1) / tile_rays_;
  guard_rays<Real>({batch.origin, batch.direction, batch.near_far}, batch.target, 0);
  const BatchScales scales = scales_of(step, batch);
  tile_losses_.assign(static_cast<std::size_t>(tiles), StepLosses{});
  for (auto& lane : lanes_) {
    for (EncoderInbox<Real>& inbox : lane->inbox) inbox.rows = 0;
  }
  if (draws_ahead()) draw_ahead(step, batch, tiles);
  parallel_for(options_.lanes, [&](std::int64_t lane) {
    for (std::int64_t tile = lane; tile < tiles; tile += options_.lanes) {
      const std::int64_t begin = tile * tile_rays_;
      tile_losses_[static_cast<std::size_t>(tile)] =
          train_tile(step, static_cast<int>(lane), batch, {begin, std::min(tile_rays_, rays - begin), tile}, scales);
    }
  });
  scatter(step);
  store_.reduce_lanes();
  StepContext ctx = context(step, true, 0, 0);
  for (const Pass<Real>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.derive_backward(ctx);
  }
  StepLosses sum;
  for (const StepLosses& tile : tile_losses_) {  // tile order: the same sum for any thread count
    sum.color += tile.color;
    sum.semantic += tile.semantic;
    sum.mse += tile.mse;
    for (std::size_t i = 0; i < options_.losses.entries().size(); ++i) sum.terms[i] += tile.terms[i];
    sum.samples += tile.samples;
    sum.labelled += tile.labelled;
    sum.correct += tile.correct;
    sum.dense_passes |= tile.dense_passes;
  }
  const double values = color_normaliser(batch);
  sum.color /= values;
  sum.mse /= values;
  sum.semantic = scales.semantic > 0 ? sum.semantic / scales.semantic : 0;
  sum.active = scales.terms.active;
  sum.total = sum.color + options_.semantic_weight * sum.semantic + options_.losses.finish(scales.terms, sum.terms);
  return sum;
}

// A tile on the processor: sums are the tile's, gradients at encoders are collected for the scatter of whole lanes.
template <class Real>
class Pipeline<Real>::TileExecutor final : public StepExecutor<Real> {
 public:
  TileExecutor(Pipeline& pipeline, int lane, const TileRange& tile, const BatchScales& scales, double color_normaliser)
      : pipeline_(pipeline), lane_(lane), tile_(tile), scales_(scales), color_normaliser_(color_normaliser) {}

  StepLosses losses;

  const SampledTile<Real>* drawn() const override {
    const bool drawn = pipeline_.draws_ahead() && tile_.number != kAlone;
    return drawn ? &pipeline_.ahead_.tiles[static_cast<std::size_t>(tile_.number)] : nullptr;
  }
  void color_loss(std::size_t, Workspace&, View<const Real> color, View<const float> target,
                  View<Real> d_color) override {
    losses.mse = photometric_loss<Real>(color, target, color_normaliser_, 1.0, d_color);
    losses.color += losses.mse;
  }
  void semantic_loss(std::size_t, Workspace&, View<const Real> logits, const SemanticTargets& targets,
                     View<Real> d_logits) override {
    const PipelineOptions& options = pipeline_.options_;
    const auto classes = static_cast<std::int32_t>(options.class_weight.size());
    const View<const float> class_weight =
        classes == 0 ? View<const float>() : View<const float>(options.class_weight.data(), 1, classes);
    const SemanticLoss semantic = semantic_cross_entropy<Real>(logits, targets, class_weight, scales_.semantic,
                                                               options.semantic_weight, d_logits, tile_.begin);
    losses.semantic += semantic.sum;
    losses.labelled = semantic.labelled;
    losses.correct = semantic.correct;
  }
  LossTraits active_terms() const override {
    return scales_.terms.active != 0 ? pipeline_.options_.losses.traits(scales_.terms.active) : LossTraits{};
  }
  void add_terms(std::size_t, Workspace&, const RayTargets& targets, const RayValues<Real>& values,
                 const RayGradients<Real>& gradients) override {
    pipeline_.options_.losses.template add<Real>(scales_.terms, targets, values, gradients, losses.terms);
  }
  void count(std::size_t pass, const PassTrace<Real>& trace) override {
    losses.samples = trace.samples.count;
    if (any_density(trace)) losses.dense_passes |= 1U << pass;
  }
  View<Real> encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, Workspace& arena) override {
    const std::int32_t dims = trace.encoded.cols;
    if (tile_.number == kAlone) return arena.take<Real>(trace.samples.count, dims);
    Ahead& ahead = pipeline_.ahead_;
    if (drawn() == nullptr) return pipeline_.lanes_[static_cast<std::size_t>(lane_)]->inbox[pass].append(trace.x, dims);
    const std::int64_t row = ahead.row[static_cast<std::size_t>(tile_.number)];
    return {ahead.d_encoded.data() + dims * row, trace.samples.count, dims};
  }
  void use_encoded_gradient(std::size_t pass, const PassTrace<Real>& trace, const StepContext&,
                            View<Real> d_encoded) override {
    if (tile_.number != kAlone) return;
    RayGuard<Real>(pipeline_.passes_[pass].parts().name, tile_.begin, trace.samples)
        .per_sample("gradient of the encoded position", d_encoded);
  }

 private:
  Pipeline& pipeline_;
  int lane_;
  TileRange tile_;
  const BatchScales& scales_;
  double color_normaliser_;
};

template <class Real>
StepLosses Pipeline<Real>::train_tile(std::int64_t step, int lane, const RayBatch& batch, const TileRange& tile,
                                      const BatchScales& scales) {
  const std::int64_t begin = tile.begin, count = tile.count;
  const StepContext ctx = context(step, true, lane, begin);
  const Workspace::Scope tile_scope(*ctx.workspace);
  TrainedRays rays;
  rays.lane = lane;
  rays.batch = batch;
  rays.batch.origin = batch.origin.row_range(begin, count);
  rays.batch.direction = batch.direction.row_range(begin, count);
  rays.batch.near_far = batch.near_far.row_range(begin, count);
  rays.batch.target = batch.target.row_range(begin, count);
  rays.batch.label = rows_of(batch.label, begin, count);
  rays.batch.soft = rows_of(batch.soft, begin, count);
  rays.batch.depth = rows_of(batch.depth, begin, count);
  if (has_semantics() && !batch.label.empty()) {
    for (std::int64_t r = 0; r < count; ++r) {
      if (options_.head_on_all_rays || rays.batch.label(r, 0) != kVoid) rays.semantic_rays = r + 1;
    }
  }
  // The tile of the batch that holds these rays begins with the rays that are there for their labels.
  const std::int64_t tile_begin = begin / tile_rays_ * tile_rays_;
  const std::int64_t tile_end = std::min(tile_begin + tile_rays_, batch.origin.rows);
  rays.first_color = std::clamp<std::int64_t>(
      tile_begin + label_only_rays(batch.label_only_share, tile_begin, tile_end) - begin, 0, count);
  TileExecutor executor(*this, lane, tile, scales, color_normaliser(batch));
  train_rays<Real>(passes_, per_ray_, rays, ctx, executor);
  return executor.losses;
}

template <class Real>
typename Pipeline<Real>::BatchScales Pipeline<Real>::scales_of(std::int64_t step, const RayBatch& batch) const {
  return {batch_normaliser(batch), options_.losses.scales(step, targets_of(batch), batch.origin.rows)};
}

template <class Real>
void Pipeline<Real>::render(const RenderJob<Real>& job) {
  const WorkScope scope(options_.work);
  const std::int64_t rays = job.origin.rows;
  guard_rays<Real>({job.origin, job.direction, job.near_far}, {}, 0);
  if constexpr (std::is_same_v<Real, float>) {
    if (device_ != nullptr) return device_->render(job);
  }
  const std::int64_t tiles = (rays + tile_rays_ - 1) / tile_rays_;
  parallel_for(options_.lanes, [&](std::int64_t lane) {
    for (std::int64_t tile = lane; tile < tiles; tile += options_.lanes) {
      const std::int64_t begin = tile * tile_rays_;
      render_tile(static_cast<int>(lane), job, begin, std::min(tile_rays_, rays - begin));
    }
  });
}

template <class Real>
void Pipeline<Real>::density(View<const double> positions, View<Real> sigma) const {
  const WorkScope scope(options_.work);
  if constexpr (std::is_same_v<Real, float>) {
    if (device_ != nullptr) return device_->density(positions, sigma);
  }
  const Pass<Real>& pass = passes_.back();
  parallel_for(options_.lanes, [&](std::int64_t lane) {
    const std::int64_t share = (positions.rows + options_.lanes - 1) / options_.lanes;
    const std::int64_t begin = std::min(lane * share, positions.rows);
    const std::int64_t count = std::min(share, positions.rows - begin);
    StepContext ctx = context(0, false, static_cast<int>(lane), 0);
    ctx.pass = pass.parts().number;
    pass.density(ctx, positions.row_range(begin, count), sigma.row_range(begin, count));
  });
}

template <class Real>
void Pipeline<Real>::render_tile(int lane, const RenderJob<Real>& job, std::int64_t begin, std::int64_t count) {
  StepContext ctx = context(0, false, lane, begin);
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope tile_scope(arena);
  Rays<Real> rays;
  rays.origin = job.origin.row_range(begin, count);
  rays.direction = job.direction.row_range(begin, count);
  rays.near_far = job.near_far.row_range(begin, count);
  const bool semantics = has_semantics() && !(job.label.empty() && job.entropy.empty() && job.confidence.empty());
  Proposal<Real> proposal;
  PassTrace<Real> trace;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    ctx.pass = passes_[p].parts().number;
    const bool last = p + 1 == passes_.size();
    PassTrace<Real> next = passes_[p].forward(ctx, lane, rays, p == 0 ? nullptr : &proposal,
                                              p == 0 ? 0 : per_ray_[p - 1], {last && semantics ? count : 0, last});
    trace = next;
    proposal.samples = &trace.samples;
    proposal.weight = trace.weight.row_range(0, trace.samples.count);
  }
  for (std::int64_t r = 0; r < count; ++r) {
    for (int i = 0; i < 3 && !job.color.empty(); ++i) job.color(begin + r, i) = trace.color(r, i);
    if (!job.depth.empty()) job.depth(begin + r, 0) = trace.depth(r, 0);
    if (!job.opacity.empty()) job.opacity(begin + r, 0) = trace.opacity(r, 0);
    if (!job.resolution.empty()) {
      job.resolution(begin + r, 0) =
          opacity_resolution<Real>(trace.samples, trace.weight, options_.rules.far, r, job.footprint_per_m);
    }
  }
  if (!semantics) return;
  if (!job.entropy.empty()) softmax_entropy<Real>(trace.logits, job.entropy.row_range(begin, count));
  softmax<Real>(trace.logits, trace.logits);
  for (std::int64_t r = 0; r < count; ++r) {
    const Real* const p = trace.logits.row(r);
    const Real* const best = std::max_element(p, p + trace.logits.cols);
    if (!job.label.empty()) job.label(begin + r, 0) = static_cast<std::int16_t>(best - p);
    if (!job.confidence.empty()) job.confidence(begin + r, 0) = *best;
    if (!job.truth_probability.empty()) {
      const std::int16_t truth = job.truth(begin + r, 0);
      job.truth_probability(begin + r, 0) = truth == kVoid ? Real(0) : p[truth];
    }
  }
}

template <class Real>
std::size_t Pipeline<Real>::predicted_workspace_bytes(std::int64_t rays) const {
  std::vector<const PassParts<Real>*> parts;
  for (const Pass<Real>& pass : passes_) parts.push_back(&pass.parts());
  return plan_network(parts, options_, rays, 1, true).workspace();
}

template <class Real>
std::size_t Pipeline<Real>::workspace_bytes() const {
  std::size_t sum = ahead_.bytes();
  for (const auto& lane : lanes_) {
    sum += lane->arena.high_water_bytes();
    for (const EncoderInbox<Real>& inbox : lane->inbox)
      sum += inbox.x.capacity() * sizeof(double) + inbox.dy.capacity() * sizeof(Real);
  }
  return sum;
}

template <class Real>
std::int64_t Pipeline<Real>::workspace_growths() const {
  std::int64_t sum = 0;
  for (const auto& lane : lanes_) sum += lane->arena.growth_count();
  return sum;
}

template class Pipeline<float>;
template class Pipeline<double>;

}  // namespace semfield
