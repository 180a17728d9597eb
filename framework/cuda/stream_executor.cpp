#include "cuda/stream_executor.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "classes/class_table.h"
#include "core/check.h"
#include "core/error.h"
#include "cuda/calls.h"
#include "cuda/device.h"
#include "cuda/kernel_tables.h"
#include "cuda/kernels/adam.h"
#include "cuda/kernels/layers.h"
#include "cuda/matmul.h"
#include "cuda/stages.h"
#include "execution/train_rays.h"
#include "model/ray_guard.h"

namespace semfield::cuda {

namespace {

// Position of the last ray with a label, plus one.
std::int64_t last_labelled(View<const std::int16_t> label) {
  std::int64_t n = label.rows;
  while (n > 0 && label(n - 1, 0) == kVoid) --n;
  return n;
}

}  // namespace

StreamExecutor::StreamExecutor(Pipeline<float>& host, std::vector<PassParts<float>> parts, const DeviceOptions& options)
    : host_(host),
      options_(options),
      losses_(loss_kernels(host.options().losses, options.kernels)),
      train_arena_(arena_source()),
      beside_arena_(arena_source()),
      render_arena_(arena_source()) {
  SEMFIELD_CHECK(parts.size() <= static_cast<std::size_t>(kMostPasses), "a device runs at most 4 passes");
  const LaunchScope on_device(step_launch());
  check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "making a stream");
  check(cudaStreamCreateWithFlags(&beside_, cudaStreamNonBlocking), "making a stream");
  check(cudaEventCreateWithFlags(&forked_, cudaEventDisableTiming), "making an event");
  check(cudaEventCreateWithFlags(&joined_, cudaEventDisableTiming), "making an event");
  const LaunchScope on_stream(step_launch());
  store_ = std::make_unique<Store>(host.store(), options.trainable);
  passes_.reserve(parts.size());
  std::vector<std::size_t> ends;
  for (PassParts<float>& part : parts) {
    passes_.emplace_back(std::move(part), host.options().rules, *store_);
    ends.push_back(store_->gradients_added());
  }
  sums_ = std::make_unique<GradientSums>(options, store_->gradients(), std::move(ends));
  render_fault_ = Buffer<FaultKey>(1, "fault of a call");
  const std::vector<float>& weight = host.options().class_weight;
  class_weight_ = Buffer<float>(weight.size(), "class weights");
  cuda::upload<float>(weight, class_weight_.data());
  upload(0);
}

StreamExecutor::~StreamExecutor() {
  Launch own;
  own.ordinal = options_.ordinal;
  const LaunchScope scope(own);
  forget_graphs();
  sums_.reset();  // before the wait: it may be for a rank that has ended
  (void)cudaStreamSynchronize(stream_);
  (void)cudaEventDestroy(joined_);
  (void)cudaEventDestroy(forked_);
  for (const cudaStream_t stream : {beside_, stream_}) {
    (void)cudaStreamSynchronize(stream);
    cuda::forget_stream(stream);
    (void)cudaStreamDestroy(stream);
  }
}

std::string StreamExecutor::description() const { return describe_device(options_.ordinal); }

Launch StreamExecutor::step_launch() const {
  Launch next;
  next.ordinal = options_.ordinal;
  next.stream = stream_;
  next.deterministic = options_.deterministic;
  if (staging_) {
    next.cell = staging_->cell();
    next.fault = &staging_->device_sums()->fault;
  }
  return next;
}

StepContext StreamExecutor::context(std::int64_t step, bool training, Workspace& arena) const {
  StepContext ctx;
  ctx.seed = host_.options().seed;
  ctx.step = step;
  ctx.training = training;
  ctx.workspace = &arena;
  return ctx;
}

void StreamExecutor::upload(std::int64_t step) {
  host_.derive(step);
  const LaunchScope scope(step_launch());
  store_->upload();
  const StepContext ctx = context(step, false, render_arena_);
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
  synchronize();
}

void StreamExecutor::download(std::int64_t step) {
  const LaunchScope scope(step_launch());
  store_->download();
  host_.derive(step);
}

void StreamExecutor::set_gradient_hook(GradientHook<float> hook) {
  SEMFIELD_CHECK(queued_.empty(), "a gradient hook is set between steps");
  forget_graphs();
  hook_ = std::move(hook);
}

void StreamExecutor::forget_graphs() {
  for (Shape& shape : shapes_) {
    for (cudaGraphExec_t& graph : shape.graphs) {
      if (graph != nullptr) (void)cudaGraphExecDestroy(graph);
      graph = nullptr;
    }
    shape.runs = 0;
  }
}

std::int64_t StreamExecutor::tile_rays(std::int64_t rays) const {
  return std::max<std::int64_t>(1, shard_of(rays, 0, sums_->shards()).count);
}

std::int64_t StreamExecutor::labelled_rays(const RayBatch& batch) const {
  std::int64_t most = 0;
  for (int s = 0; s < sums_->shards() && !batch.targets.label.empty(); ++s) {
    const RayRange rays = shard_of(batch.origin.rows, s, sums_->shards());
    most = std::max(most, last_labelled(batch.targets.label.row_range(rays.begin, rays.count)));
  }
  return most;
}

StreamExecutor::Shape& StreamExecutor::shape_of(const RayBatch& batch, std::int64_t labelled, std::uint32_t terms) {
  const std::int64_t rays = tile_rays(batch.origin.rows), group = std::max<std::int64_t>(1, rays / kGroups);
  std::int64_t semantic_rays = host_.has_semantics() ? labelled : 0;
  if (host_.options().head_on_all_rays && host_.has_semantics()) semantic_rays = rays;
  semantic_rays = std::min(rays, (semantic_rays + group - 1) / group * group);
  const auto known = std::find_if(shapes_.begin(), shapes_.end(),
                                  [&](const Shape& s) { return s.semantic_rays == semantic_rays && s.terms == terms; });
  return known != shapes_.end() ? *known : shapes_.emplace_back(Shape{semantic_rays, terms});
}

void StreamExecutor::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  SEMFIELD_CHECK(std::ssize(queued_) < kSlots, "too many steps wait on the device");
  guard_rays<float>({batch.origin, batch.direction, batch.near_far}, batch.targets.color, 0);
  const BatchScales scales = host_.scales_of(batch);
  const LaunchScope on_stream(render_launch());
  sums_->join();
  Shape* shape = nullptr;
  try {
    sums_->agree([&] {
      shape = &stage(step, batch, update, scales);
      const LaunchScope scope(step_launch());
      begin_step(*shape, step);
    });
  } catch (const RankLost&) {
    throw;
  } catch (const Error&) {
    try {
      drop_gradients();
    } catch (const Error&) {  // the device fails, as the first error says
    }
    throw;
  }
  sums_->afterwards([&] {
    const LaunchScope scope(step_launch());
    end_step(*shape, step);
    observe(step);
    staging_->fetch(static_cast<int>(queued_.size()));
  });
  queued_.push_back({step, scales});
}

// Of a step that is not made: the next one begins anew.
void StreamExecutor::drop_gradients() {
  store_->clear_gradients();
  if (!staging_) return;
  check(cudaMemsetAsync(&staging_->device_sums()->fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
}

// Memory for the step, and its way to the device.
StreamExecutor::Shape& StreamExecutor::stage(std::int64_t step, const RayBatch& batch, const AdamStep& update,
                                             const BatchScales& scales) {
  const auto [first, last] = sums_->own();
  const std::int64_t begin = shard_of(batch.origin.rows, first, sums_->shards()).begin;
  const RayRange end = shard_of(batch.origin.rows, last - 1, sums_->shards());
  const RayBatch own = batch.rows(begin, end.begin + end.count - begin);
  sums_->reserve();
  if (!staging_ || rays_ != batch.origin.rows || !staging_->fits(own)) {
    SEMFIELD_CHECK(queued_.empty(), "batches of one size are queued together");
    forget_graphs();
    shapes_.clear();
    staging_ = std::make_unique<Staging>(kSlots, own);
    rays_ = batch.origin.rows;
    color_normaliser_ = color_normaliser(batch);
  }
  const std::int64_t labelled = labelled_rays(batch);
  StepCell cell;
  cell.step = static_cast<std::uint64_t>(step);
  cell.adam = update;
  cell.adam.labelled = labelled > 0;
  cell.semantic_normaliser = scales.semantic;
  std::copy(scales.terms.scale.begin(), scales.terms.scale.end(), cell.loss_scale);
  staging_->send(static_cast<int>(queued_.size()), cell, own);
  return shape_of(batch, labelled, scales.terms.active);
}

// These launches are no part of a graph: the step's number comes by value.
void StreamExecutor::observe(std::int64_t step) {
  Launch by_value = launch();
  by_value.cell = nullptr;
  const LaunchScope scope(by_value);
  StepContext ctx = context(step + 1, true, train_arena_);
  for (const Pass<float>& pass : passes_) {
    ctx.pass = pass.parts().number;
    pass.observe(ctx);
  }
}

void StreamExecutor::begin_step(Shape& shape, std::int64_t step) {
  if (growths() != growths_) {  // graphs hold addresses of the arenas
    forget_graphs();
    growths_ = growths();
  }
  try {
    if (!shape.captured()) return backward(shape, step, false);
    if (shape.graphs[0] == nullptr) {
      capture(shape.graphs[0], [&] {
        backward(shape, step, true);
        if (!sums_->waits()) sums_->meet(launch().fault);
        if (!splits()) update(step);
      });
    }
    if (splits() && shape.graphs[1] == nullptr) capture(shape.graphs[1], [&] { update(step); });
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    throw with_settings_that_fit(error, shape, step);
  }
}

void StreamExecutor::end_step(Shape& shape, std::int64_t step) {
  const bool captured = shape.captured();
  if (captured) start(shape.graphs[0]);
  if (!captured || sums_->waits()) sums_->meet(launch().fault);
  if (hook_) {
    try {
      hook_({step, store_->learned_gradients(), stream_});
    } catch (...) {
      store_->clear_gradients();
      throw;
    }
  }
  if (!captured) {
    update(step);
  } else if (splits()) {
    start(shape.graphs[1]);
  }
  shape.runs = std::min(shape.runs + 1, kRunsBeforeCapture);
}

void StreamExecutor::capture(cudaGraphExec_t& graph, const std::function<void()>& body) {
  cudaGraph_t captured = nullptr;
  check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeThreadLocal), "capturing a step");
  try {
    body();
  } catch (...) {
    (void)cudaStreamEndCapture(stream_, &captured);
    if (captured != nullptr) (void)cudaGraphDestroy(captured);
    throw;
  }
  check(cudaStreamEndCapture(stream_, &captured), "capturing a step");
  check(cudaGraphInstantiate(&graph, captured, 0), "making a graph of a step");
  check(cudaGraphDestroy(captured), "making a graph of a step");
}

void StreamExecutor::start(cudaGraphExec_t graph) { check(cudaGraphLaunch(graph, stream_), "starting a step"); }

void StreamExecutor::backward(const Shape& shape, std::int64_t step, bool overlapped) {
  StepSums* const sums = staging_->device_sums();
  check(cudaMemsetAsync(sums->shard, 0, sizeof sums->shard, stream_), "clearing sums");
  sums_->begin(overlapped);
  const auto [first, last] = sums_->own();
  const std::int64_t begin = shard_of(rays_, first, sums_->shards()).begin;
  for (int s = first; s < last; ++s) {
    const Workspace::Scope scope(train_arena_), beside(beside_arena_);
    const RayRange rays = shard_of(rays_, s, sums_->shards());
    store_->zero_derived_gradients();
    const Shard shard{staging_->batch().rows(rays.begin - begin, rays.count), rays.begin, s - first};
    if (rays.count > 0) walk(shape, shard, step);
    sums_->shard_done(s);
  }
}

void StreamExecutor::update(std::int64_t step) {
  const Workspace::Scope scope(train_arena_);
  check_gradients(store_->learned());
  stages().adam(&launch().cell->adam, store_->learned());
  const StepContext ctx = context(step, true, train_arena_);
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
}

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
  View<float> encoded_gradient(std::size_t, const PassTrace<float>& trace, Workspace& arena) override {
    return arena.take<float>(trace.encoded.rows, trace.encoded.cols);
  }
  void use_encoded_gradient(std::size_t pass, const PassTrace<float>& trace, const StepContext& ctx,
                            View<float> d_encoded) override {
    const LiveRows<float> live(stages(), trace.samples);
    owner_.passes_[pass].scatter(ctx, trace.x, d_encoded);
  }
  StepContext begin_branch(const StepContext& ctx) override {
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
    check(cudaEventRecord(owner_.joined_, owner_.beside_), "marking a semantic branch");
    check(cudaStreamWaitEvent(owner_.stream_, owner_.joined_, 0), "waiting for a semantic branch");
  }

  void pass_done(std::size_t pass) override {
    owner_.passes_[pass].derive_backward(ctx_);
    owner_.sums_->pass_done(pass);
  }

 private:
  LossSums* sums(std::size_t pass) const { return &owner_.staging_->device_sums()->shard[shard_][pass]; }

  StreamExecutor& owner_;
  const Shape& shape_;
  int shard_;
  StepContext ctx_;
  std::optional<LaunchScope> branch_;
};

void StreamExecutor::walk(const Shape& shape, const Shard& shard, std::int64_t step) {
  StepContext ctx = context(step, true, train_arena_);
  ctx.first_ray = shard.first_ray;
  const std::int64_t count = shard.batch.origin.rows;
  TrainedRays rays;
  rays.batch = shard.batch;
  rays.semantic_rays = std::min(shape.semantic_rays, count);
  rays.first_color = shard.batch.without_color();
  ShardExecutor executor(*this, shape, shard.number, ctx);
  train_rays<float>(passes_, host_.per_ray(), rays, ctx, executor);
}

}  // namespace semfield::cuda

namespace {
void add_kernels(semfield::KernelTables& tables) { semfield::cuda::add_plugin_kernels(tables); }
std::string describe(int ordinal) { return semfield::cuda::describe_device(ordinal); }
std::unique_ptr<semfield::Executor<float>> make(semfield::Pipeline<float>& host,
                                                std::vector<semfield::PassParts<float>> parts,
                                                const semfield::DeviceOptions& options) {
  return std::make_unique<semfield::cuda::StreamExecutor>(host, std::move(parts), options);
}
}  // namespace

extern "C" const semfield::DeviceLibrary* semfield_device_library();
extern "C" const semfield::DeviceLibrary* semfield_device_library() {
  static const semfield::DeviceLibrary library{add_kernels, &semfield::cuda::stages(), describe, make,
                                               semfield::cuda::device_calls()};
  return &library;
}
