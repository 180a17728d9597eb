// The walk of a step on the device: one shard of the batch on the step's stream, or several side by side, each on a
// stream of its own.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "core/check.h"
#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "cuda/stages.h"
#include "cuda/stream_executor.h"
#include "execution/lane_executor.h"
#include "execution/train_rays.h"

namespace semfield::cuda {

// A shard on the device: sums go into those of the step, and semantic branches run on a stream of their own.
class StreamExecutor::ShardExecutor final : public StepExecutor<float> {
 public:
  ShardExecutor(StreamExecutor& owner, const Shape& shape, int shard, const StepContext& ctx)
      : owner_(owner), shape_(shape), shard_(shard), ctx_(ctx) {}

  void color_loss(std::size_t pass, Workspace& arena, View<const float> color, View<const float> target,
                  View<float> d_color) override {
    photometric_loss(arena, color, target, owner_.color_normaliser_, d_color, sums(pass));
  }
  void semantic_loss(std::size_t pass, Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                     View<float> d_logits) override {
    const auto classes = static_cast<std::int32_t>(owner_.class_weight_.size());
    semantic_cross_entropy(arena, logits, targets,
                           classes == 0 ? View<const float>() : owner_.class_weight_.view(1, classes),
                           owner_.host_.options().rules.semantics.weight, d_logits, sums(pass));
  }
  const LossList& losses() const override { return owner_.host_.options().losses; }
  std::uint32_t active_losses() const override { return shape_.terms; }
  void add_losses(std::size_t pass, Workspace& arena, std::uint32_t which, const RayTargets& targets,
                  const RayValues<float>& values, const RayGradients<float>& gradients) override {
    cuda::add_losses(arena, owner_.losses_, which, {targets, values, gradients}, sums(pass));
  }
  void count(std::size_t pass, const PassTrace<float>& trace) override {
    count_samples(trace.samples.first, trace.sigma, sums(pass));
  }
  View<float> encoded_gradient(std::size_t pass, const PassTrace<float>& trace, Workspace& arena) override {
    if (in_place(pass)) return place(pass, trace.encoded.rows).dy;
    return arena.take<float>(trace.encoded.rows, trace.encoded.cols);
  }
  void use_encoded_gradient(std::size_t pass, const PassTrace<float>& trace, const StepContext& ctx,
                            View<float> d_encoded) override {
    if (owner_.tracks_.empty()) {
      const LiveRows<float> live(stages(), trace.samples);
      owner_.passes_[pass].scatter(ctx, trace.x, d_encoded);
      return;
    }
    EncoderRowsOfPass& rows = owner_.rows_[pass];  // all shards' are scattered at once
    const View<std::int32_t> first = trace.samples.first;
    if (in_place(pass)) {
      const View<double> x = place(pass, trace.encoded.rows).x;
      stages().copy(bytes_of(View<const double>(trace.x)), bytes_of(x));
    } else {
      rows.shard.push_back({trace.x, d_encoded, first.data + first.rows - 1, nullptr});
    }
    const LiveRows<float> live(stages(), trace.samples);
    find_largest(d_encoded, rows.all->largest());
  }
  // Shards that run beside each other fill the device as it is.
  StepContext begin_branch(const StepContext& ctx) override {
    if (!owner_.tracks_.empty()) return ctx;
    check(cudaEventRecord(owner_.forked_, owner_.stream_), "marking a step");
    check(cudaStreamWaitEvent(owner_.beside_, owner_.forked_, 0), "waiting for a step");
    Launch next = launch();
    next.stream = owner_.beside_;
    branch_.emplace(next);
    StepContext beside = ctx;
    beside.workspace = &owner_.beside_arena_;
    return beside;
  }
  void end_branch() override { branch_.reset(); }
  void join_branch() override {
    if (!owner_.tracks_.empty()) return;
    check(cudaEventRecord(owner_.joined_, owner_.beside_), "marking a semantic branch");
    check(cudaStreamWaitEvent(owner_.stream_, owner_.joined_, 0), "waiting for a semantic branch");
  }

  void pass_done(std::size_t pass) override {
    if (!owner_.tracks_.empty()) return;  // complete_gradients
    owner_.passes_[pass].derive_backward(ctx_);
    if (owner_.cameras_ && pass + 1 == owner_.passes_.size()) owner_.cameras_->derive_backward(ctx_);
    owner_.sums_->pass_done(pass);
  }

 private:
  bool in_place(std::size_t pass) const { return !owner_.tracks_.empty() && owner_.rows_[pass].all->size().in_place; }
  EncoderRows place(std::size_t pass, std::int64_t rows) const {
    const std::int64_t first = (ctx_.first_ray - owner_.first_ray()) * owner_.host_.per_ray()[pass];
    return owner_.rows_[pass].all->place(first, rows);
  }
  LossSums* sums(std::size_t pass) const { return &owner_.staging_->device_sums()->shard[shard_][pass]; }

  StreamExecutor& owner_;
  const Shape& shape_;
  int shard_;
  StepContext ctx_;
  std::optional<LaunchScope> branch_;
};

RayBatch StreamExecutor::moved(const RayBatch& batch, Workspace& arena) const {
  if (!cameras_ || !cameras_->rules().poses) return batch;
  const auto copy = [&](View<const double> from) {
    const View<double> to = arena.take<double>(from.rows, from.cols);
    stages().copy(bytes_of(from), bytes_of(to));
    return to;
  };
  const View<double> origin = copy(batch.origin), direction = copy(batch.direction);
  cameras_->move(batch.targets.more[channel::camera], origin, direction);
  RayBatch seen = batch;
  seen.origin = origin;
  seen.direction = direction;
  return seen;
}

void StreamExecutor::walk(const Shape& shape, const Shard& shard, std::int64_t step, Workspace& arena) {
  StepContext ctx = context(step, true, arena);
  ctx.first_ray = shard.first_ray;
  const std::int64_t count = shard.batch.origin.rows;
  TrainedRays<float> rays;
  rays.batch = moved(shard.batch, arena);
  rays.cameras = cameras_ ? &*cameras_ : nullptr;
  rays.lane = shard.lane;
  rays.room = room_.rows();
  rays.semantic_rays = std::min(shape.semantic_rays, count);
  rays.first_color = shard.batch.without_color();
  ShardExecutor executor(*this, shape, shard.number, ctx);
  train_rays<float>(passes_, host_.per_ray(), rays, ctx, executor);
}

void StreamExecutor::backward(const Shape& shape, std::int64_t step, bool overlapped) {
  StepSums* const sums = staging_->device_sums();
  check(cudaMemsetAsync(sums->shard, 0, sizeof sums->shard, stream_), "clearing sums");
  sums_->begin(overlapped);
  store_->zero_derived_gradients();
  walk_shards(shape, step, tile_rays(rays_));
}

std::int64_t StreamExecutor::first_ray() const { return shard_of(rays_, sums_->own().first, sums_->shards()).begin; }

// The first `most` rays of each of this rank's shards.
void StreamExecutor::walk_shards(const Shape& shape, std::int64_t step, std::int64_t most) {
  const auto [first, last] = sums_->own();
  const std::int64_t begin = first_ray();
  const RayBatch batch = staging_->batch();
  const auto shard_at = [&](int s) {
    const RayRange rays = shard_of(rays_, s, sums_->shards());
    return Shard{batch.rows(rays.begin - begin, std::min(most, rays.count)), rays.begin, s - first, kMainGradient};
  };
  if (tracks_.empty()) {
    const Workspace::Scope scope(train_arena_), beside(beside_arena_);
    const Shard shard = shard_at(first);
    if (shard.batch.origin.rows > 0) walk(shape, shard, step, train_arena_);
    return;
  }
  for (EncoderRowsOfPass& pass : rows_) {
    pass.shard.clear();
    if (pass.all) pass.all->begin();
  }
  store_->clear_lanes(first, last - first);
  check(cudaEventRecord(forked_, stream_), "marking a step");
  std::deque<Workspace::Scope> taken;  // until the rows of encoders are collected
  for (int s = first; s < last; ++s) {
    Track& track = tracks_[static_cast<std::size_t>(s - first)];
    check(cudaStreamWaitEvent(track.stream, forked_, 0), "waiting for a step");
    Launch next = launch();
    next.stream = track.stream;
    next.beside = kShards;  // whoever walks the others: grids of sums are part of the bits
    const LaunchScope scope(next);
    taken.emplace_back(track.arena);
    Shard shard = shard_at(s);
    shard.lane = s;
    if (shard.batch.origin.rows > 0) walk(shape, shard, step, track.arena);
    check(cudaEventRecord(track.walked, track.stream), "marking a shard");
  }
  for (Track& track : tracks_) check(cudaStreamWaitEvent(stream_, track.walked, 0), "waiting for a shard");
  for (EncoderRowsOfPass& pass : rows_) {
    if (pass.all && !pass.all->size().in_place) pass.all->collect(pass.shard);
  }
}

// What shards have left becomes the gradients of the batch.
void StreamExecutor::complete_gradients(std::int64_t step) {
  if (tracks_.empty()) return;
  StepContext ctx = context(step, true, train_arena_);
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    if (!rows_[p].all) continue;
    const Workspace::Scope scope(train_arena_);
    const EncoderRows rows = rows_[p].all->all();
    Launch next = launch();
    next.live_rows = rows.count;
    next.largest = rows.largest;
    const LaunchScope known(next);
    ctx.pass = passes_[p].parts().number;
    passes_[p].scatter(ctx, rows.x, rows.dy);
  }
  store_->add_lanes();
  for (const Pass<float>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.derive_backward(ctx);
  }
  if (cameras_) cameras_->derive_backward(ctx);
}

// Memory that a step of this batch needs beside the arenas.
void StreamExecutor::reserve_gradients() {
  if (!tracks_.empty()) {
    rows_.resize(passes_.size());
    for (std::size_t p = 0; p < passes_.size(); ++p) {
      if (!passes_[p].scatters()) continue;
      const ShardRows::Size size{passes_[p].encoded_dims(), rays_ * host_.per_ray()[p],
                                 !passes_[p].parts().sampler->traits().keeps_to_room};
      std::unique_ptr<ShardRows>& rows = rows_[p].all;
      if (!rows || rows->size() != size) rows = std::make_unique<ShardRows>(size);
    }
  }
  sums_->reserve();
}

// Steps whose batches are drawn on the device.

namespace {

bool has_finite_rays(const PixelPool& pool) {
  return std::all_of(pool.frames.begin(), pool.frames.end(), [](const PixelPool::Frame& frame) {
    const Pose& pose = frame.world_from_camera;
    bool finite = frame.camera.has_finite_lens();
    for (int i = 0; i < 3; ++i) {
      finite = finite && std::isfinite(pose.t[i]);
      for (int axis = 0; axis < 3; ++axis) finite = finite && std::isfinite(pose.axis(axis)[i]);
    }
    return finite;
  });
}

}  // namespace

// Several ranks have rank 0's pixels, and steps come from it.
bool StreamExecutor::hold(const PixelPool& pool) {
  SEMFIELD_CHECK(queued_.empty(), "pixels are taken in between steps");
  if (sums_->ranks() > 1 || !options_.trainable || pool.tile_rays != tile_rays(pool.rays)) return false;
  if (!has_finite_rays(pool)) return false;  // the host says which
  const LaunchScope scope(step_launch());
  try {
    if (drawer_ && drawer_->relabel(pool)) return true;
    drawer_.reset();
    const std::size_t bytes = BatchDrawer::bytes_of(pool, kSlots), most = free_bytes() / 2;
    if (bytes > most) {
      if (std::exchange(told_of_pixels_, true)) return false;
      notes_.push_back(
          fmt::format("pixels stay in the host's memory, which makes the batches of steps: they take {:.1f} GB "
                      "of the device's, where {:.1f} GB are left for them",
                      static_cast<double>(bytes) * 1e-9, static_cast<double>(most) * 1e-9));
      return false;
    }
    drawer_ = std::make_unique<BatchDrawer>(pool, kSlots);
  } catch (const Error&) {  // of a label, or of memory: a step that the host draws says it where it counts
    drawer_.reset();
    return false;
  }
  return true;
}

std::vector<std::string> StreamExecutor::take_notes() {
  std::vector<std::string> notes = sums_->take_notes();
  notes.insert(notes.end(), notes_.begin(), notes_.end());
  notes_.clear();
  return notes;
}

void StreamExecutor::queue_drawn(std::int64_t step, std::uint32_t terms, const AdamStep& update) {
  const LaunchScope scope(step_launch());
  drawer_->draw(step);
  RayBatch batch = drawer_->seen(step);
  batch.terms = terms;
  queue_batch(step, batch, update, drawer_->batch(step));
}

// What steps leave, read when they are waited for: sums of shards and ranks to losses, and faults.

namespace {

// In order, so that the sum does not depend on which rank had the shard.
void add(LossSums& sum, const LossSums& shard) {
  sum.squares += shard.squares;
  sum.semantic += shard.semantic;
  for (std::size_t i = 0; i < kMostLossTerms; ++i) sum.terms[i] += shard.terms[i];
  sum.labelled += shard.labelled;
  sum.correct += shard.correct;
  sum.samples += shard.samples;
  sum.dense |= shard.dense;
}

}  // namespace

StepLosses StreamExecutor::losses_of(std::span<const StepSums* const> sums, const BatchScales& scales) const {
  StepLosses out;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    LossSums pass;
    for (int r = 0; r < sums_->ranks(); ++r) {
      const auto [first, last] = sums_->own_of(r);
      for (int s = first; s < last; ++s) add(pass, sums[static_cast<std::size_t>(r)]->shard[s - first][p]);
    }
    out.color += pass.squares;
    out.semantic += pass.semantic;
    out.mse = pass.squares;
    for (std::size_t i = 0; i < kMostLossTerms; ++i) out.terms[i] += pass.terms[i];
    out.samples = pass.samples;
    out.labelled = pass.labelled;
    out.correct = pass.correct;
    if (pass.dense != 0) out.dense_passes |= 1U << p;
  }
  return host_.means_of(out, scales);
}

StepResults StreamExecutor::finish() {
  done_.clear();
  std::optional<std::int64_t> failed;
  const std::vector<Queued> queued = std::exchange(queued_, {});
  if (queued.empty()) return {};
  const LaunchScope scope(step_launch());
  for (std::size_t slot = 0; slot < queued.size() && !failed;) {
    sums_->agree([&] { sums_->wait(); });
    const std::vector<StepSums> all = sums_->of_all_ranks(staging_->sums(queued.size()));
    bool has_room = true;
    for (; slot < queued.size() && !failed; ++slot) {
      std::vector<const StepSums*> of_step;
      FaultKey fault = kNoFault;
      for (std::size_t at = slot; at < all.size(); at += queued.size()) {
        of_step.push_back(&all[at]);
        fault = std::min(fault, all[at].fault);
      }
      has_room = fault == kNoFault || static_cast<Stage>(fault >> kFaultRowBits) != Stage::room;
      if (!has_room) break;
      const StepLosses losses = losses_of(of_step, queued[slot].scales);
      if (fault != kNoFault || !std::isfinite(losses.total)) {
        failed = queued[slot].step;
      } else {
        done_.push_back(losses);
      }
    }
    if (!has_room) run_again(queued, slot);
  }
  if (failed) {
    drop_gradients();
    synchronize();
  } else {
    std::int64_t samples = 0;
    for (const StepSums& sums : staging_->sums(queued.size())) samples = std::max(samples, sums.shard[0][0].samples);
    if (room_.saw(samples)) {
      forget_graphs();
      forget_step();
    }
  }
  return {done_, failed, std::nullopt};
}

}  // namespace semfield::cuda
