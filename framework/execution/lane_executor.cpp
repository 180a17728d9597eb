#include "execution/lane_executor.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <numeric>
#include <utility>

#include "compute/isa.h"
#include "compute/math_functions.h"
#include "core/check.h"
#include "model/losses/semantic_cross_entropy.h"
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

constexpr std::int64_t kRowsAhead = 1024;  // encoded in one call; by row, so it changes no bits

template <class Real>
Rays<Real> rays_of_tile(const RayBatch& batch, std::int64_t tile, std::int64_t tile_rays) {
  const std::int64_t begin = tile * tile_rays, count = std::min(tile_rays, batch.origin.rows - begin);
  Rays<Real> rays;
  rays.origin = batch.origin.row_range(begin, count);
  rays.direction = batch.direction.row_range(begin, count);
  rays.near_far = batch.near_far.row_range(begin, count);
  return rays;
}

template <class T>
void grow(std::vector<T>& buffer, std::int64_t size) {
  if (buffer.size() < static_cast<std::size_t>(size)) buffer.resize(static_cast<std::size_t>(size));
}

template <class T>
std::size_t allocated_bytes(const std::vector<T>& buffer) {
  return buffer.capacity() * sizeof(T);
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
  return {.seed = options().seed, .step = step, .training = training, .first_ray = first_ray, .workspace = &arena};
}

template <class Real>
std::string LaneExecutor<Real>::matrix_products() const {
  return std::string(isa_name(isa()));
}

template <class Real>
void LaneExecutor<Real>::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  const WorkScope scope(options().work);
  const ComputeFloatMode mode;
  const StepLosses losses = gradients(step, batch);
  pipeline_.require_sound(step, losses);
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
  SEMFIELD_CHECK(!inside_parallel(), "a sampler asks for densities outside parallel regions");
  const auto answer = [&](std::int64_t begin, std::int64_t end) {
    arenas_.for_units((end - begin + kPiece - 1) / kPiece, [&](Workspace& arena, std::int64_t i) {
      StepContext local = ctx;
      local.workspace = &arena;
      const std::int64_t first = begin + i * kPiece, count = std::min(kPiece, end - first);
      pass.density(local, positions.row_range(first, count), sigma.row_range(first, count));
    });
  };
  if (!ranks_) return answer(0, positions.rows);
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
  pipeline_.store().zero_gradients();
  guard_rays<Real>({batch.origin, batch.direction, batch.near_far}, batch.targets.color, 0);
  const BatchScales scales = pipeline_.scales_of(batch);
  const RayBatch seen = moved(batch);
  const auto walk = [&] {
    if (draws_ahead()) draw_ahead(step, seen, tiles);
    walk_tiles(step, seen, tiles, scales);
  };
  if (ranks_) {
    ranks_->share_out(tiles);
    agree(ranks_->all(), walk);
    ranks_->gather_losses(tile_losses_);
  } else {
    walk();
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
  // Lanes with tiles of the step, the one with most samples first as far as they are known; else lanes with a tile more
  // than others have the low numbers.
  const std::int64_t with_tiles = std::min<std::int64_t>(end_lane(), tiles) - first_lane();
  lane_order_.resize(static_cast<std::size_t>(std::max<std::int64_t>(0, with_tiles)));
  std::iota(lane_order_.begin(), lane_order_.end(), first_lane());
  if (draws_ahead())
    std::sort(lane_order_.begin(), lane_order_.end(), [&](int a, int b) {
      const std::int64_t of_a = ahead_.lane_rows(a), of_b = ahead_.lane_rows(b);
      return of_a != of_b ? of_a > of_b : a < b;
    });
  arenas_.for_units(std::ssize(lane_order_), [&](Workspace& arena, std::int64_t i) {
    const int lane = lane_order_[static_cast<std::size_t>(i)];
    for (std::int64_t tile = lane; tile < tiles; tile += options().lanes) {
      const std::int64_t tile_rays = pipeline_.tile_rays(), begin = tile * tile_rays;
      const TileRange range{begin, std::min(tile_rays, batch.origin.rows - begin), tile};
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
    guard_values<Real>({owner_.passes()[pass].parts().name, tile_.begin, &trace.samples}, Guarded::encoded_gradient,
                       d_encoded);
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
    render_rays(passes(), pipeline_.rendered_per_ray(), job.rows(begin, std::min(unit, rays - begin)),
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

// Which ray or tensor is behind a step that failed.

template <class Real>
std::optional<RayFault> LaneExecutor<Real>::find_fault(std::int64_t step, const RayBatch& batch) {
  const WorkScope scope(options().work);
  const ComputeFloatMode mode;
  std::optional<RayFault> fault;
  BatchScales scales;
  scales.color = color_normaliser(batch);
  scales.semantic = 1;
  try {
    scales = pipeline_.scales_of(batch);
  } catch (const Error&) {
    // A label of some ray: that ray throws again below.
  }
  pipeline_.store().clear_gradients();
  const RayBatch seen = moved(batch);
  for (std::int64_t ray = 0; ray < batch.origin.rows && !fault; ++ray) {
    try {
      guard_rays<Real>(
          {batch.origin.row_range(ray, 1), batch.direction.row_range(ray, 1), batch.near_far.row_range(ray, 1)},
          batch.targets.color.row_range(ray, 1), ray);
      train_tile(context(step, true, ray, arenas_.own()), 0, seen, {ray, 1, kAlone}, scales);
    } catch (const RayFault& found) {
      fault = found;
    } catch (const Error& error) {
      fault.emplace(ray, error.kind(), error.code(), error.message(), error.remedy());
    }
    for (const Tensor<Real>& t : pipeline_.store().all()) {
      if (fault || t.lanes.size() == 0) continue;
      const Real* const lane = t.lanes.data();
      if (all_finite(lane, t.size())) continue;
      std::int64_t at = 0;
      while (all_finite(lane + at, 1)) ++at;
      fault.emplace(ray, ErrorKind::failure, Code("train.gradient.not_finite"),
                    "the gradient of '" + t.name + "' at " + element_text(t, at) + " that ray " + std::to_string(ray) +
                        " gives is " + std::to_string(lane[at]),
                    std::string(fault_remedy()));
    }
  }
  pipeline_.store().clear_gradients();
  return fault;
}

// A step's rows for a position encoder with tables: collected tile by tile, or drawn ahead of all tiles.

template <class Real>
View<Real> EncoderInbox<Real>::append(View<const double> tile_x, std::int32_t dims) {
  const auto begin = static_cast<std::size_t>(rows), count = static_cast<std::size_t>(tile_x.rows);
  const auto width = static_cast<std::size_t>(dims);
  x.resize((begin + count) * 3);
  dy.resize((begin + count) * width);
  std::memcpy(x.data() + begin * 3, tile_x.data, count * 3 * sizeof(double));
  rows += tile_x.rows;
  return View<Real>(dy.data() + begin * width, tile_x.rows, dims);
}

template <class Real>
std::size_t LaneExecutor<Real>::Ahead::bytes() const {
  return allocated_bytes(t) + allocated_bytes(delta) + allocated_bytes(ray_of_sample) + allocated_bytes(first) +
         allocated_bytes(x) + allocated_bytes(encoded) + allocated_bytes(d_encoded);
}

template <class Real>
void LaneExecutor<Real>::draw_ahead(std::int64_t step, const RayBatch& batch, std::int64_t tiles) {
  Ahead& a = ahead_;
  const Pass<Real>& pass = passes()[0];
  const std::int64_t capacity = pipeline_.per_ray()[0] * pipeline_.tile_rays();
  grow(a.t, tiles * capacity);
  grow(a.delta, tiles * capacity);
  grow(a.ray_of_sample, tiles * capacity);
  grow(a.first, tiles * (pipeline_.tile_rays() + 1));
  grow(a.tiles, tiles);
  grow(a.row, tiles);
  arenas_.for_units(tiles, [&](Workspace& arena, std::int64_t tile) {
    if (!is_own(tile)) return;
    StepContext ctx = context(step, true, tile * pipeline_.tile_rays(), arena);
    ctx.pass = passes()[0].parts().number;
    const Rays<Real> rays = rays_of_tile<Real>(batch, tile, pipeline_.tile_rays());
    Samples<Real>& samples = a.tiles[static_cast<std::size_t>(tile)].samples;
    samples.t = {a.t.data() + tile * capacity, capacity, 1};
    samples.delta = {a.delta.data() + tile * capacity, capacity, 1};
    samples.ray_of_sample = {a.ray_of_sample.data() + tile * capacity, capacity, 1};
    samples.first = {a.first.data() + tile * (pipeline_.tile_rays() + 1), rays.origin.rows + 1, 1};
    pass.sample(ctx, rays, nullptr, samples);
    const Workspace::Scope scratch(arena);
    SampledTile<Real> all;
    all.samples = samples;
    all.per_ray = pipeline_.per_ray()[0];
    const SampledTile<Real> reached = pass.reached(ctx, kMainGradient, rays, all, 0);
    if (!reached.reached) return;
    a.tiles[static_cast<std::size_t>(tile)].reached = true;
    samples.count = reached.samples.count;
    std::copy_n(reached.samples.t.data, samples.count, samples.t.data);
    std::copy_n(reached.samples.delta.data, samples.count, samples.delta.data);
    std::copy_n(reached.samples.ray_of_sample.data, samples.count, samples.ray_of_sample.data);
    std::copy_n(reached.samples.first.data, samples.first.rows, samples.first.data);
  });
  // Lane after lane, as the encoder's gradients are summed. Lane l has the tiles l, l + lanes, ... Those of other
  // processes have no rows here.
  const std::int32_t dims = pass.encoded_dims();
  a.rows = 0;
  grow(a.lane_begin, options().lanes + 1);
  for (int lane = 0; lane < options().lanes; ++lane) {
    a.lane_begin[static_cast<std::size_t>(lane)] = a.rows;
    for (std::int64_t tile = lane; tile < tiles && is_own(tile); tile += options().lanes) {
      a.row[static_cast<std::size_t>(tile)] = a.rows;
      a.rows += a.tiles[static_cast<std::size_t>(tile)].samples.count;
    }
  }
  a.lane_begin.back() = a.rows;
  grow(a.x, 3 * a.rows);
  grow(a.encoded, dims * a.rows);
  grow(a.d_encoded, dims * a.rows);
  arenas_.for_units(tiles, [&](Workspace& arena, std::int64_t tile) {
    if (!is_own(tile)) return;
    SampledTile<Real>& sampled = a.tiles[static_cast<std::size_t>(tile)];
    const std::int64_t row = a.row[static_cast<std::size_t>(tile)], count = sampled.samples.count;
    sampled.x = {a.x.data() + 3 * row, count, 3};
    sampled.encoded = {a.encoded.data() + dims * row, count, dims};
    pass.locate(context(step, true, tile * pipeline_.tile_rays(), arena),
                rays_of_tile<Real>(batch, tile, pipeline_.tile_rays()), sampled.samples, sampled.x);
  });
  const auto encode = [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
    pass.encode(context(step, true, 0, arena), kMainGradient, {a.x.data() + 3 * begin, count, 3},
                {a.encoded.data() + dims * begin, count, dims});
  };
  if (a.rows == 0) return;
  if (pass.parts().position->traits().whole_batch) return encode(arenas_.own(), 0, a.rows);
  arenas_.for_units((a.rows + kRowsAhead - 1) / kRowsAhead, [&](Workspace& arena, std::int64_t i) {
    encode(arena, i * kRowsAhead, std::min(kRowsAhead, a.rows - i * kRowsAhead));
  });
}

template <class Real>
void LaneExecutor<Real>::scatter(std::int64_t step) {
  StepContext ctx = context(step, true);
  for (std::size_t p = 0; p < passes().size(); ++p) {
    if (!passes()[p].scatters()) continue;
    if (!draws_ahead()) {
      ctx.pass = passes()[p].parts().number;
      gather(p);
    }
    EncodedRows<Real> rows{{ahead_.x.data(), ahead_.rows, 3},
                           {ahead_.d_encoded.data(), ahead_.rows, passes()[p].encoded_dims()}};
    if (ranks_) rows = ranks_->gather_rows(rows);
    passes()[p].scatter(ctx, rows.x, rows.d_encoded);
  }
}

// What the lanes have for pass p, lane after lane, where a pass that draws ahead has its rows: an encoder's tables are
// then walked once.
template <class Real>
void LaneExecutor<Real>::gather(std::size_t p) {
  Ahead& a = ahead_;
  a.rows = 0;
  grow(a.lane_begin, std::ssize(inboxes_) + 1);
  for (std::size_t lane = 0; lane < inboxes_.size(); ++lane) {
    a.lane_begin[lane] = a.rows;
    a.rows += inboxes_[lane][p].rows;
  }
  const std::int32_t dims = passes()[p].encoded_dims();
  grow(a.x, 3 * a.rows);
  grow(a.d_encoded, dims * a.rows);
  parallel_for(std::ssize(inboxes_), [&](std::int64_t lane) {
    const EncoderInbox<Real>& inbox = inboxes_[static_cast<std::size_t>(lane)][p];
    const std::int64_t begin = a.lane_begin[static_cast<std::size_t>(lane)];
    std::copy_n(inbox.x.data(), 3 * inbox.rows, a.x.data() + 3 * begin);
    std::copy_n(inbox.dy.data(), dims * inbox.rows, a.d_encoded.data() + dims * begin);
  });
}

template class LaneExecutor<float>;
template class LaneExecutor<double>;

}  // namespace semfield
