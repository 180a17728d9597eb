#include "cuda/stream_executor.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "core/check.h"
#include "core/error.h"
#include "cuda/grouping_lessons.h"
#include "cuda/kernel_tables.h"
#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "cuda/stages.h"
#include "execution/train_rays.h"
#include "model/ray_guard.h"
#include "scene/classes/class_table.h"

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
  store_ = std::make_unique<Store>(host.store(), options.trainable, GradientSums::lanes_of(options));
  passes_.reserve(parts.size());
  store_->freeze(host.options().cameras.alone);
  std::vector<std::size_t> ends;
  for (PassParts<float>& part : parts) {
    passes_.emplace_back(std::move(part), host.options().rules, *store_);
    ends.push_back(store_->gradients_added());
  }
  store_->freeze(false);
  if (host.cameras() != nullptr) {
    cameras_.emplace(host.options().cameras, cuda::stages(), *store_);
    ends.back() = store_->gradients_added();
  }
  sums_ = std::make_unique<GradientSums>(options, store_->gradients(), std::move(ends));
  const auto [first, last] = sums_->own();
  for (int s = first; s < last && GradientSums::lanes_of(options) > 0; ++s) {
    Track& track = tracks_.emplace_back();
    check(cudaStreamCreateWithFlags(&track.stream, cudaStreamNonBlocking), "making a stream");
    check(cudaEventCreateWithFlags(&track.walked, cudaEventDisableTiming), "making an event");
  }
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
  std::vector<cudaStream_t> streams{beside_, stream_};
  for (const Track& track : tracks_) {
    (void)cudaEventDestroy(track.walked);
    streams.push_back(track.stream);
  }
  for (const cudaStream_t stream : streams) {
    (void)cudaStreamSynchronize(stream);
    cuda::forget_stream(stream);
    (void)cudaStreamDestroy(stream);
  }
}

std::int64_t StreamExecutor::growths() const {
  std::int64_t all = train_arena_.growth_count() + beside_arena_.growth_count();
  for (const Track& track : tracks_) all += track.arena.growth_count();
  return all;
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
  derive(ctx);
  synchronize();
}

void StreamExecutor::derive(const StepContext& ctx) const {
  for (const Pass<float>& pass : passes_) pass.derive(ctx);
  if (cameras_) cameras_->derive(ctx);
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
  return known_shape(std::min(rays, (semantic_rays + group - 1) / group * group), terms);
}

StreamExecutor::Shape& StreamExecutor::known_shape(std::int64_t semantic_rays, std::uint32_t terms) {
  const auto known = std::find_if(shapes_.begin(), shapes_.end(),
                                  [&](const Shape& s) { return s.semantic_rays == semantic_rays && s.terms == terms; });
  return known != shapes_.end() ? *known : shapes_.emplace_back(Shape{semantic_rays, terms});
}

void StreamExecutor::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  guard_rays<float>({batch.origin, batch.direction, batch.near_far}, batch.targets.color, 0);
  queue_batch(step, batch, update, nullptr);
}

void StreamExecutor::queue_batch(std::int64_t step, const RayBatch& batch, const AdamStep& update,
                                 const std::byte* drawn) {
  SEMFIELD_CHECK(std::ssize(queued_) < kSlots, "too many steps wait on the device");
  const BatchScales scales = host_.scales_of(batch);
  const LaunchScope on_stream(render_launch());
  sums_->join();
  StepCell cell;
  cell.step = static_cast<std::uint64_t>(step);
  cell.adam = update;
  cell.semantic_normaliser = scales.semantic;
  std::copy(scales.terms.scale.begin(), scales.terms.scale.end(), cell.loss_scale);
  const Shape& shape =
      run_step(step, static_cast<int>(queued_.size()), [&]() -> Shape& { return stage(cell, batch, scales, drawn); });
  queued_.push_back({step, scales, shape.semantic_rays, shape.terms, drawn != nullptr});
}

StreamExecutor::Shape& StreamExecutor::run_step(std::int64_t step, int slot, const std::function<Shape&()>& prepare) {
  Shape* shape = nullptr;
  try {
    sums_->agree([&] {
      shape = &prepare();
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
    staging_->fetch(slot);
  });
  return *shape;
}

void StreamExecutor::run_again(std::span<const Queued> queued, std::size_t first) {
  room_.give_all();
  drop_gradients();
  forget_graphs();
  for (std::size_t slot = first; slot < queued.size(); ++slot) {
    (void)run_step(queued[slot].step, static_cast<int>(slot), [&]() -> Shape& {
      if (queued[slot].drawn) drawer_->draw(queued[slot].step);
      staging_->send_again(static_cast<int>(slot), queued[slot].drawn ? drawer_->batch(queued[slot].step) : nullptr);
      return known_shape(queued[slot].semantic_rays, queued[slot].terms);
    });
  }
}

// Of a step that is not made: the next one begins anew.
void StreamExecutor::drop_gradients() {
  store_->clear_gradients();
  if (!staging_) return;
  check(cudaMemsetAsync(&staging_->device_sums()->fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
}

// Memory for the step, and its way to the device.
StreamExecutor::Shape& StreamExecutor::stage(const StepCell& of_step, const RayBatch& batch, const BatchScales& scales,
                                             const std::byte* drawn) {
  const auto [first, last] = sums_->own();
  const std::int64_t begin = shard_of(batch.origin.rows, first, sums_->shards()).begin;
  const RayRange end = shard_of(batch.origin.rows, last - 1, sums_->shards());
  const RayBatch own = batch.rows(begin, end.begin + end.count - begin);
  if (!staging_ || rays_ != batch.origin.rows || !staging_->fits(own)) {
    SEMFIELD_CHECK(queued_.empty(), "batches of one size are queued together");
    forget_graphs();
    shapes_.clear();
    staging_ = std::make_unique<Staging>(kSlots, own);
    rays_ = batch.origin.rows;
    color_normaliser_ = color_normaliser(batch);
    const bool leaves_room =
        passes_.size() == 1 && tracks_.empty() && passes_.front().parts().sampler->traits().keeps_to_room;
    room_.begin(leaves_room ? own.origin.rows * host_.per_ray().front() : 0);
  }
  reserve_gradients();
  const std::int64_t labelled = labelled_rays(batch);
  StepCell cell = of_step;
  cell.adam.labelled = labelled > 0;
  const int slot = static_cast<int>(queued_.size());
  if (drawn == nullptr) {
    staging_->send(slot, cell, own);
  } else {
    staging_->send(slot, cell, drawn);
  }
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
        if (!sums_->waits()) {
          sums_->meet(launch().fault);
          complete_gradients(step);
        }
        if (!splits()) update(step);
      });
    }
    if (splits() && shape.graphs[1] == nullptr) {
      capture(shape.graphs[1], [&] {
        if (sums_->waits()) complete_gradients(step);
        update(step);
      });
    }
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    throw with_settings_that_fit(error, shape, step);
  }
}

void StreamExecutor::end_step(Shape& shape, std::int64_t step) {
  const bool captured = shape.captured();
  if (captured) start(shape.graphs[0]);
  if (!captured || sums_->waits()) sums_->meet(launch().fault);
  if (!captured) complete_gradients(step);
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

void StreamExecutor::update(std::int64_t step) {
  const Workspace::Scope scope(train_arena_);
  check_gradients(store_->learned());
  stages().adam(&launch().cell->adam, store_->learned());
  derive(context(step, true, train_arena_));
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
                                               semfield::cuda::device_calls(), semfield::cuda::learn_grouping};
  return &library;
}
