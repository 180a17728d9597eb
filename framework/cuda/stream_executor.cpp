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
#include "cuda/loss_terms.h"
#include "cuda/matmul.h"
#include "cuda/stages.h"
#include "execution/train_rays.h"
#include "model/ray_guard.h"

namespace semfield::cuda {

namespace {

constexpr int kRunsBeforeCapture = 2;  // a capture must find the arenas grown

// Position of the last ray with a label, plus one.
std::int64_t labelled_rays(const RayBatch& batch) {
  std::int64_t n = batch.label.empty() ? 0 : batch.label.rows;
  while (n > 0 && batch.label(n - 1, 0) == kVoid) --n;
  return n;
}

}  // namespace

StreamExecutor::StreamExecutor(Pipeline<float>& host, std::vector<PassParts<float>> parts, const DeviceOptions& options)
    : host_(host),
      options_(options),
      train_arena_(arena_source()),
      beside_arena_(arena_source()),
      render_arena_(arena_source()) {
  SEMFIELD_CHECK(parts.size() <= static_cast<std::size_t>(kMostPasses), "a device runs at most 4 passes");
  require_loss_kernels(host.options().losses);
  const LaunchScope on_device(step_launch());
  check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "making a stream");
  check(cudaStreamCreateWithFlags(&beside_, cudaStreamNonBlocking), "making a stream");
  check(cudaEventCreateWithFlags(&forked_, cudaEventDisableTiming), "making an event");
  check(cudaEventCreateWithFlags(&joined_, cudaEventDisableTiming), "making an event");
  const LaunchScope on_stream(step_launch());
  store_ = std::make_unique<Store>(host.store(), options.trainable);
  passes_.reserve(parts.size());
  for (PassParts<float>& part : parts) passes_.emplace_back(std::move(part), host.options().rules, *store_);
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
  (void)cudaStreamSynchronize(stream_);
  forget_graphs();
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

StreamExecutor::Shape& StreamExecutor::shape_of(const RayBatch& batch, std::uint32_t terms) {
  const std::int64_t rays = batch.origin.rows, group = std::max<std::int64_t>(1, rays / kGroups);
  std::int64_t semantic_rays = host_.has_semantics() ? labelled_rays(batch) : 0;
  if (host_.options().head_on_all_rays && host_.has_semantics()) semantic_rays = rays;
  semantic_rays = std::min(rays, (semantic_rays + group - 1) / group * group);
  const auto known = std::find_if(shapes_.begin(), shapes_.end(),
                                  [&](const Shape& s) { return s.semantic_rays == semantic_rays && s.terms == terms; });
  return known != shapes_.end() ? *known : shapes_.emplace_back(Shape{semantic_rays, terms});
}

void StreamExecutor::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  SEMFIELD_CHECK(std::ssize(queued_) < kSlots, "too many steps wait on the device");
  guard_rays<float>({batch.origin, batch.direction, batch.near_far}, batch.target, 0);
  const LaunchScope on_stream(render_launch());
  if (!staging_ || !staging_->fits(batch)) {
    SEMFIELD_CHECK(queued_.empty(), "batches of one size are queued together");
    forget_graphs();
    shapes_.clear();
    staging_ = std::make_unique<Staging>(kSlots, batch);
  }
  const LaunchScope scope(step_launch());
  const BatchScales scales = host_.scales_of(step, batch);
  StepCell cell;
  cell.step = static_cast<std::uint64_t>(step);
  cell.adam = update;
  cell.adam.labelled = labelled_rays(batch) > 0;
  cell.semantic_normaliser = scales.semantic;
  std::copy(scales.terms.scale.begin(), scales.terms.scale.end(), cell.loss_scale);
  const int slot = static_cast<int>(queued_.size());
  staging_->send(slot, cell, batch);
  run(shape_of(batch, scales.terms.active), step);
  const Launch observing = [&] {  // these launches are no part of a graph: the step's number comes by value
    Launch next = launch();
    next.cell = nullptr;
    return next;
  }();
  {
    const LaunchScope by_value(observing);
    StepContext ctx = context(step + 1, true, train_arena_);
    for (const Pass<float>& pass : passes_) {
      ctx.pass = pass.parts().number;
      pass.observe(ctx);
    }
  }
  staging_->fetch(slot);
  queued_.push_back({step, scales});
}

void StreamExecutor::run(Shape& shape, std::int64_t step) {
  if (growths() != growths_) {  // graphs hold addresses of the arenas
    forget_graphs();
    growths_ = growths();
  }
  try {
    run_part(shape, shape.graphs[0], [&] {
      backward(shape, step);
      if (!hook_) this->update(step);
    });
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    throw with_settings_that_fit(error, shape, step);
  }
  if (hook_) {
    try {
      hook_({step, store_->learned_gradients(), stream_});
    } catch (...) {
      store_->clear_gradients();
      throw;
    }
    run_part(shape, shape.graphs[1], [&] { this->update(step); });
  }
  shape.runs = std::min(shape.runs + 1, kRunsBeforeCapture);
}

void StreamExecutor::run_part(const Shape& shape, cudaGraphExec_t& graph, const std::function<void()>& body) {
  if (shape.runs < kRunsBeforeCapture) return body();
  if (graph == nullptr) {
    cudaGraph_t captured = nullptr;
    check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeThreadLocal), "capturing a step");
    body();
    check(cudaStreamEndCapture(stream_, &captured), "capturing a step");
    check(cudaGraphInstantiate(&graph, captured, 0), "making a graph of a step");
    check(cudaGraphDestroy(captured), "making a graph of a step");
  }
  check(cudaGraphLaunch(graph, stream_), "starting a step");
}

void StreamExecutor::backward(const Shape& shape, std::int64_t step) {
  const Workspace::Scope scope(train_arena_), beside(beside_arena_);
  StepSums* const sums = staging_->device_sums();
  check(cudaMemsetAsync(sums->pass, 0, sizeof sums->pass, stream_), "clearing sums");
  store_->zero_derived_gradients();
  const StepContext ctx = context(step, true, train_arena_);
  train_passes(shape, staging_->batch(), ctx);
  for (const Pass<float>& pass : passes_) pass.derive_backward(ctx);
}

void StreamExecutor::update(std::int64_t step) {
  const Workspace::Scope scope(train_arena_);
  check_gradients(store_->learned());
  stages().adam(&launch().cell->adam, store_->learned());
  const StepContext ctx = context(step, true, train_arena_);
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
}

// A batch on the device: sums go into those of the step, and semantic branches run on a stream of their own.
class StreamExecutor::BatchExecutor final : public StepExecutor<float> {
 public:
  BatchExecutor(StreamExecutor& owner, const Shape& shape, double color_normaliser)
      : owner_(owner), shape_(shape), color_normaliser_(color_normaliser) {}

  void color_loss(std::size_t pass, Workspace& arena, View<const float> color, View<const float> target,
                  View<float> d_color) override {
    photometric_loss(arena, color, target, color_normaliser_, d_color, sums(pass));
  }
  void semantic_loss(std::size_t pass, Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                     View<float> d_logits) override {
    const auto classes = static_cast<std::int32_t>(owner_.class_weight_.size());
    semantic_cross_entropy(arena, logits, targets,
                           classes == 0 ? View<const float>() : owner_.class_weight_.view(1, classes),
                           owner_.host_.options().rules.semantics.weight, d_logits, sums(pass));
  }
  LossTraits active_terms() const override {
    return shape_.terms != 0 ? owner_.host_.options().losses.traits(shape_.terms) : LossTraits{};
  }
  void add_terms(std::size_t pass, Workspace& arena, const RayTargets& targets, const RayValues<float>& values,
                 const RayGradients<float>& gradients) override {
    add_losses(arena, owner_.host_.options().losses, shape_.terms, targets, values, gradients, sums(pass));
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

 private:
  LossSums* sums(std::size_t pass) const { return &owner_.staging_->device_sums()->pass[pass]; }

  StreamExecutor& owner_;
  const Shape& shape_;
  double color_normaliser_;
  std::optional<LaunchScope> branch_;
};

void StreamExecutor::train_passes(const Shape& shape, const RayBatch& batch, const StepContext& ctx) {
  TrainedRays rays;
  rays.batch = batch;
  rays.semantic_rays = shape.semantic_rays;
  rays.first_color = label_only_rays(batch.label_only_share, 0, batch.origin.rows);
  BatchExecutor executor(*this, shape, color_normaliser(batch));
  train_rays<float>(passes_, host_.per_ray(), rays, ctx, executor);
}

StepLosses StreamExecutor::losses_of(const StepSums& sums, const BatchScales& scales) const {
  StepLosses out;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    const LossSums& pass = sums.pass[p];
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
  if (queued_.empty()) return {};
  const LaunchScope scope(step_launch());
  synchronize();
  for (std::size_t slot = 0; slot < queued_.size() && !failed; ++slot) {
    const StepSums& sums = staging_->sums(static_cast<int>(slot));
    const StepLosses losses = losses_of(sums, queued_[slot].scales);
    if (sums.fault != kNoFault || !std::isfinite(losses.total)) {
      failed = queued_[slot].step;
    } else {
      done_.push_back(losses);
    }
  }
  queued_.clear();
  if (failed) {
    store_->clear_gradients();
    check(cudaMemsetAsync(&staging_->device_sums()->fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
    synchronize();
  }
  return {done_, failed, std::nullopt};
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
