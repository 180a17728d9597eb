#include "cuda/pipeline.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "core/check.h"
#include "core/error.h"
#include "cuda/calls.h"
#include "cuda/device.h"
#include "cuda/kernel_tables.h"
#include "cuda/layers.h"
#include "cuda/loss_terms.h"
#include "cuda/stages.h"
#include "model/ray_guard.h"

namespace semfield::cuda {

namespace {

// Position of the last ray with a label, plus one.
std::int64_t labelled_rays(const RayBatch& batch) {
  std::int64_t n = batch.label.empty() ? 0 : batch.label.rows;
  while (n > 0 && batch.label(n - 1, 0) == kVoid) --n;
  return n;
}

std::int64_t count_labels(const RayBatch& batch) {
  std::int64_t n = 0;
  for (std::int64_t r = 0; !batch.label.empty() && r < batch.label.rows; ++r) n += batch.label(r, 0) != kVoid ? 1 : 0;
  return n;
}

}  // namespace

DevicePipeline::DevicePipeline(Pipeline<float>& host, std::vector<PassParts<float>> parts, const DeviceOptions& options)
    : host_(host),
      options_(options),
      train_arena_(arena_source()),
      beside_arena_(arena_source()),
      render_arena_(arena_source()) {
  SEMFIELD_CHECK(parts.size() <= static_cast<std::size_t>(kMostPasses), "a device runs at most 4 passes");
  require_loss_kernels(host.options().losses);
  check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "making a stream");
  check(cudaStreamCreateWithFlags(&beside_, cudaStreamNonBlocking), "making a stream");
  check(cudaEventCreateWithFlags(&forked_, cudaEventDisableTiming), "making an event");
  check(cudaEventCreateWithFlags(&joined_, cudaEventDisableTiming), "making an event");
  const LaunchScope scope(step_launch());
  store_ = std::make_unique<Store>(host, options.trainable);
  std::int64_t per_ray = 0;
  passes_.reserve(parts.size());
  for (PassParts<float>& part : parts) {
    passes_.emplace_back(std::move(part), host.options().rules, *store_);
    per_ray = passes_.back().capacity_per_ray(per_ray);
    per_ray_.push_back(per_ray);
  }
  render_fault_ = Buffer<FaultKey>(1, "fault of a call");
  const std::vector<float>& weight = host.options().class_weight;
  class_weight_ = Buffer<float>(weight.size(), "class weights");
  cuda::upload<float>(weight, class_weight_.data());
  upload();
}

DevicePipeline::~DevicePipeline() {
  (void)cudaStreamSynchronize(stream_);
  forget_graphs();
  (void)cudaEventDestroy(joined_);
  (void)cudaEventDestroy(forked_);
  (void)cudaStreamDestroy(beside_);
  (void)cudaStreamDestroy(stream_);
}

std::string DevicePipeline::description() const { return describe_device(); }

std::size_t DevicePipeline::bytes() const {
  return store_->bytes() + train_arena_.reserved_bytes() + beside_arena_.reserved_bytes() +
         render_arena_.reserved_bytes() + (staging_ ? staging_->bytes() : 0);
}

Launch DevicePipeline::step_launch() const {
  Launch next;
  next.stream = stream_;
  next.deterministic = options_.deterministic;
  if (staging_) {
    next.cell = staging_->cell();
    next.fault = &staging_->device_sums()->fault;
  }
  return next;
}

StepContext DevicePipeline::context(std::int64_t step, bool training, Workspace& arena) const {
  StepContext ctx;
  ctx.seed = host_.options().seed;
  ctx.step = step;
  ctx.training = training;
  ctx.workspace = &arena;
  return ctx;
}

void DevicePipeline::upload() {
  const LaunchScope scope(step_launch());
  store_->upload();
  StepContext ctx = context(0, false, render_arena_);
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
  synchronize();
}

void DevicePipeline::download() {
  const LaunchScope scope(step_launch());
  store_->download();
}

void DevicePipeline::forget_graphs() {
  for (Shape& shape : shapes_) {
    if (shape.graph != nullptr) (void)cudaGraphExecDestroy(shape.graph);
    shape.graph = nullptr;
    shape.runs = 0;
  }
}

void DevicePipeline::queue(std::int64_t step, const RayBatch& batch, const DeviceUpdate& update) {
  SEMFIELD_CHECK(std::ssize(queued_) < kSlots, "too many steps wait on the device");
  guard_rays<float>({batch.origin, batch.direction, batch.near_far}, batch.target, 0);
  if (!staging_ || !staging_->fits(batch)) {
    SEMFIELD_CHECK(queued_.empty(), "batches of one size are queued together");
    forget_graphs();
    shapes_.clear();
    staging_ = std::make_unique<Staging>(kSlots, batch);
  }
  const LaunchScope scope(step_launch());
  StepCell cell;
  cell.step = static_cast<std::uint64_t>(step);
  cell.adam_step_size = update.step_size;
  cell.learning_rate = update.learning_rate;
  cell.adam_root_scale = static_cast<float>(update.root_scale);
  cell.semantic_normaliser = host_.batch_normaliser(batch);
  cell.labelled = static_cast<std::int32_t>(count_labels(batch));
  const LossScales terms = host_.options().losses.scales(step, targets_of(batch), batch.origin.rows);
  std::copy(terms.scale.begin(), terms.scale.end(), cell.loss_scale);
  const int slot = static_cast<int>(queued_.size());
  staging_->send(slot, cell, batch);

  const std::int64_t rays = batch.origin.rows, group = std::max<std::int64_t>(1, rays / kGroups);
  std::int64_t semantic_rays = host_.has_semantics() ? labelled_rays(batch) : 0;
  if (host_.options().head_on_all_rays && host_.has_semantics()) semantic_rays = rays;
  semantic_rays = std::min(rays, (semantic_rays + group - 1) / group * group);
  auto shape = std::find_if(shapes_.begin(), shapes_.end(), [&](const Shape& s) {
    return s.semantic_rays == semantic_rays && s.terms == terms.active;
  });
  if (shape == shapes_.end()) shape = shapes_.insert(shapes_.end(), {semantic_rays, terms.active, 0, nullptr});
  try {
    run(*shape, step);
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    throw with_settings_that_fit(error, *shape, step);
  }
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
  queued_.push_back({step, cell.semantic_normaliser, color_normaliser(batch), terms});
}

void DevicePipeline::run(Shape& shape, std::int64_t step) {
  if (growths() != growths_) {  // graphs hold addresses of the arenas
    forget_graphs();
    growths_ = growths();
  }
  if (shape.graph != nullptr) {
    check(cudaGraphLaunch(shape.graph, stream_), "starting a step");
    return;
  }
  if (shape.runs < 2) {  // a capture must find the arena grown
    step_body(shape, step);
    ++shape.runs;
    return;
  }
  cudaGraph_t graph = nullptr;
  check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeThreadLocal), "capturing a step");
  step_body(shape, step);
  check(cudaStreamEndCapture(stream_, &graph), "capturing a step");
  check(cudaGraphInstantiate(&shape.graph, graph, 0), "making a graph of a step");
  check(cudaGraphDestroy(graph), "making a graph of a step");
  check(cudaGraphLaunch(shape.graph, stream_), "starting a step");
}

void DevicePipeline::step_body(const Shape& shape, std::int64_t step) {
  const Workspace::Scope scope(train_arena_), beside(beside_arena_);
  StepSums* const sums = staging_->device_sums();
  check(cudaMemsetAsync(sums->pass, 0, sizeof sums->pass, stream_), "clearing sums");
  store_->zero_derived_gradients();
  StepContext ctx = context(step, true, train_arena_);
  train_passes(shape, staging_->batch(), ctx);
  for (const Pass<float>& pass : passes_) pass.derive_backward(ctx);
  check_gradients(store_->learned(), store_->learned_count(), store_->learned_elements());
  AdamParams rule;
  rule.beta1 = options_.adam.beta1;
  rule.beta2 = options_.adam.beta2;
  rule.epsilon = options_.adam.epsilon;
  adam_update(rule, store_->learned(), store_->learned_count(), store_->learned_elements());
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
}

// A batch on the device: sums go into those of the step, and semantic branches run on a stream of their own.
class DevicePipeline::BatchExecutor final : public StepExecutor<float> {
 public:
  BatchExecutor(DevicePipeline& pipeline, const Shape& shape, double color_normaliser)
      : pipeline_(pipeline), shape_(shape), color_normaliser_(color_normaliser) {}

  void color_loss(std::size_t pass, Workspace& arena, View<const float> color, View<const float> target,
                  View<float> d_color) override {
    photometric_loss(arena, color, target, color_normaliser_, d_color, sums(pass));
  }
  void semantic_loss(std::size_t pass, Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                     View<float> d_logits) override {
    const auto classes = static_cast<std::int32_t>(pipeline_.class_weight_.size());
    semantic_cross_entropy(arena, logits, targets,
                           classes == 0 ? View<const float>() : pipeline_.class_weight_.view(1, classes),
                           pipeline_.host_.options().semantic_weight, d_logits, sums(pass));
  }
  LossTraits active_terms() const override {
    return shape_.terms != 0 ? pipeline_.host_.options().losses.traits(shape_.terms) : LossTraits{};
  }
  void add_terms(std::size_t pass, Workspace& arena, const RayTargets& targets, const RayValues<float>& values,
                 const RayGradients<float>& gradients) override {
    add_losses(arena, pipeline_.host_.options().losses, shape_.terms, targets, values, gradients, sums(pass));
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
    pipeline_.passes_[pass].scatter(ctx, trace.x, d_encoded);
  }
  StepContext begin_branch(const StepContext& ctx) override {
    check(cudaEventRecord(pipeline_.forked_, pipeline_.stream_), "marking a step");
    check(cudaStreamWaitEvent(pipeline_.beside_, pipeline_.forked_, 0), "waiting for a step");
    Launch next = launch();
    next.stream = pipeline_.beside_;
    next.beside = true;
    branch_.emplace(next);
    StepContext beside = ctx;
    beside.workspace = &pipeline_.beside_arena_;
    return beside;
  }
  void end_branch() override { branch_.reset(); }
  void join_branch() override {
    check(cudaEventRecord(pipeline_.joined_, pipeline_.beside_), "marking a semantic branch");
    check(cudaStreamWaitEvent(pipeline_.stream_, pipeline_.joined_, 0), "waiting for a semantic branch");
  }

 private:
  LossSums* sums(std::size_t pass) const { return &pipeline_.staging_->device_sums()->pass[pass]; }

  DevicePipeline& pipeline_;
  const Shape& shape_;
  double color_normaliser_;
  std::optional<LaunchScope> branch_;
};

void DevicePipeline::train_passes(const Shape& shape, const RayBatch& batch, const StepContext& ctx) {
  TrainedRays rays;
  rays.batch = batch;
  rays.semantic_rays = shape.semantic_rays;
  rays.first_color = label_only_rays(batch.label_only_share, 0, batch.origin.rows);
  BatchExecutor executor(*this, shape, color_normaliser(batch));
  train_rays<float>(passes_, per_ray_, rays, ctx, executor);
}

StepLosses DevicePipeline::losses_of(const StepSums& sums, const Queued& of) const {
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
  const double values = of.color_normaliser;
  out.color /= values;
  out.mse /= values;
  out.semantic = of.normaliser > 0 ? out.semantic / of.normaliser : 0;
  out.active = of.terms.active;
  out.total =
      out.color + host_.options().semantic_weight * out.semantic + host_.options().losses.finish(of.terms, out.terms);
  return out;
}

DeviceSteps DevicePipeline::finish() {
  DeviceSteps out;
  if (queued_.empty()) return out;
  const LaunchScope scope(step_launch());
  synchronize();
  for (std::size_t slot = 0; slot < queued_.size(); ++slot) {
    const StepSums& sums = staging_->sums(static_cast<int>(slot));
    const StepLosses losses = losses_of(sums, queued_[slot]);
    if (sums.fault != kNoFault || !std::isfinite(losses.total)) {
      out.failed = queued_[slot].step;
      break;
    }
    out.losses.push_back(losses);
  }
  queued_.clear();
  if (out.failed) {
    store_->clear_gradients();
    check(cudaMemsetAsync(&staging_->device_sums()->fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
    synchronize();
  }
  return out;
}

}  // namespace semfield::cuda

namespace {
void add_kernels(semfield::KernelTables& tables) { semfield::cuda::add_plugin_kernels(tables); }
std::string describe() { return semfield::cuda::describe_device(); }
std::unique_ptr<semfield::DeviceBackend> make(semfield::Pipeline<float>& host,
                                              std::vector<semfield::PassParts<float>> parts,
                                              const semfield::DeviceOptions& options) {
  return std::make_unique<semfield::cuda::DevicePipeline>(host, std::move(parts), options);
}
}  // namespace

extern "C" const semfield::DeviceLibrary* semfield_device_library();
extern "C" const semfield::DeviceLibrary* semfield_device_library() {
  static const semfield::DeviceLibrary library{add_kernels, &semfield::cuda::stages(), describe, make,
                                               semfield::cuda::device_calls()};
  return &library;
}
