#include "cuda/stream_executor.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/check.h"
#include "core/error.h"
#include "cuda/matmul.h"
#include "execution/lane_executor.h"
#include "execution/train_rays.h"
#include "model/stages.h"
#include "scene/classes/class_table.h"

namespace semfield::cuda {

namespace {

// Position of the last ray with a label, plus one.
std::int64_t last_labelled(View<const std::int16_t> label) {
  std::int64_t n = label.rows;
  while (n > 0 && label(n - 1, 0) == kVoid) --n;
  return n;
}

// Which settings fit into the device's memory, found by trying: said when a step does not.

constexpr double kMargin = 0.9;      // of what is free: for graphs, products' workspaces and neighbours
constexpr std::int64_t kRound = 32;  // rays

// Steps whose batches are drawn on the device.

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

// What steps leave, read when they are waited for: sums of ranks to losses, and faults.

// In the order of ranks.
void add(LossSums& sum, const LossSums& part) {
  sum.squares += part.squares;
  sum.semantic += part.semantic;
  for (std::size_t i = 0; i < kMostLossTerms; ++i) sum.terms[i] += part.terms[i];
  sum.labelled += part.labelled;
  sum.samples += part.samples;
  sum.dense |= part.dense;
}

// The semantic part at points of space: what it reads there, its logits, and steps of learning from points.

constexpr std::int64_t kChunkPoints = std::int64_t{1} << 17;

template <class T>
View<const T> column(std::span<const T> values) {
  return {values.data(), std::ssize(values), 1};
}

// The numbers of each step, as kernels read them.
std::vector<StepCell> cells_of(const PointLessons<float>& lessons) {
  std::vector<StepCell> cells(lessons.updates.size());
  for (std::size_t n = 0; n < cells.size(); ++n) {
    cells[n].step = n;
    cells[n].adam = lessons.updates[n];
    cells[n].semantic_normaliser = static_cast<double>(lessons.batch);
  }
  return cells;
}

// Rendering and density queries: a batch is cut into chunks, whose results are waited for at the end.

constexpr std::int64_t kFewestRays = 256;
constexpr std::int64_t kChunkPositions = std::int64_t{1} << 20;

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
  render_fault_ = Buffer<FaultKey>(1, "fault of a call");
  const std::vector<float>& weight = host.options().class_weight;
  class_weight_ = Buffer<float>(weight.size(), "class weights");
  cuda::upload<float>(weight, class_weight_.data());
  upload(0);
}

StreamExecutor::~StreamExecutor() {
  const LaunchScope scope({.ordinal = options_.ordinal});
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

std::int64_t StreamExecutor::growths() const { return train_arena_.growth_count() + beside_arena_.growth_count(); }

std::string StreamExecutor::description() const { return describe_device(options_.ordinal); }

Launch StreamExecutor::step_launch() const {
  Launch next{.ordinal = options_.ordinal, .stream = stream_, .deterministic = options_.deterministic};
  if (staging_) {
    next.cell = staging_->cell();
    next.fault = &staging_->device_sums()->fault;
  }
  return next;
}

StepContext StreamExecutor::context(std::int64_t step, bool training, Workspace& arena) const {
  return {.seed = host_.options().seed, .step = step, .training = training, .workspace = &arena};
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
  return std::max<std::int64_t>(1, rays_of(rays, 0, sums_->ranks()).count);
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
  const LaunchScope on_stream({.ordinal = options_.ordinal, .stream = stream_, .fault = render_fault_.data()});
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
    {  // these launches are no part of a graph: the step's number comes by value
      Launch by_value = launch();
      by_value.cell = nullptr;
      const LaunchScope observing(by_value);
      StepContext ctx = context(step + 1, true, train_arena_);
      for (const Pass<float>& pass : passes_) {
        ctx.pass = pass.parts().number;
        pass.observe(ctx);
      }
    }
    staging_->fetch(slot);
  });
  return *shape;
}

void StreamExecutor::run_again(std::span<const Queued> queued, std::size_t first) {
  room_.give_all();
  reached_room_.give_all();
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
  const RayRange part = sums_->own(batch.origin.rows);
  const RayBatch own = batch.rows(part.begin, part.count);
  if (!staging_ || rays_ != batch.origin.rows || !staging_->fits(own)) {
    SEMFIELD_CHECK(queued_.empty(), "batches of one size are queued together");
    forget_graphs();
    shapes_.clear();
    staging_ = std::make_unique<Staging>(kSlots, own);
    rays_ = batch.origin.rows;
    color_normaliser_ = color_normaliser(batch);
    const bool leaves_room =
        passes_.size() == 1 && !options_.deterministic && passes_.front().parts().sampler->traits().keeps_to_room;
    const std::int64_t most = leaves_room ? own.origin.rows * host_.per_ray().front() : 0;
    room_.begin(most);
    reached_room_.begin(most);
  }
  sums_->reserve();
  std::int64_t labelled = 0;  // rays of a part at most, those behind others included
  for (int r = 0; r < sums_->ranks() && !batch.targets.label.empty(); ++r) {
    const RayRange rays = rays_of(batch.origin.rows, r, sums_->ranks());
    labelled = std::max(labelled, last_labelled(batch.targets.label.row_range(rays.begin, rays.count)));
  }
  StepCell cell = of_step;
  cell.adam.labelled = labelled > 0;
  const int slot = static_cast<int>(queued_.size());
  if (drawn == nullptr) {
    staging_->send(slot, cell, own);
  } else {
    staging_->send(slot, cell, drawn);
  }
  const std::int64_t rays = tile_rays(rays_), group = std::max<std::int64_t>(1, rays / kGroups);
  std::int64_t semantic_rays = host_.has_semantics() ? labelled : 0;
  if (host_.options().head_on_all_rays && host_.has_semantics()) semantic_rays = rays;
  return known_shape(std::min(rays, (semantic_rays + group - 1) / group * group), scales.terms.active);
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
        if (sums_->waits()) return;
        sums_->meet(launch().fault);
        update(step);
      });
    }
    if (sums_->waits() && shape.graphs[1] == nullptr) {
      capture(shape.graphs[1], [&] { update(step); });
    }
  } catch (const Error& error) {
    if (error.kind() != ErrorKind::unavailable) throw;
    throw with_settings_that_fit(error, shape, step);
  }
}

void StreamExecutor::end_step(Shape& shape, std::int64_t step) {
  const bool captured = shape.captured();
  if (captured) check(cudaGraphLaunch(shape.graphs[0], stream_), "starting a step");
  if (!captured || sums_->waits()) sums_->meet(launch().fault);
  if (!captured) {
    update(step);
  } else if (sums_->waits()) {
    check(cudaGraphLaunch(shape.graphs[1], stream_), "starting a step");
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

void StreamExecutor::update(std::int64_t step) {
  const Workspace::Scope scope(train_arena_);
  check_gradients(store_->learned());
  stages().adam(&launch().cell->adam, store_->learned());
  derive(context(step, true, train_arena_));
}

void StreamExecutor::forget_step() {
  synchronize();
  check(cudaStreamSynchronize(beside_), "waiting for the device");
  train_arena_.forget();
  beside_arena_.forget();
}

// Halves a part until it fits; what that took says what a ray takes. Parameters stay as they are.
Error StreamExecutor::with_settings_that_fit(const Error& error, const Shape& shape, std::int64_t step) {
  room_.give_all();
  reached_room_.give_all();
  const std::int64_t rays = tile_rays(rays_);
  // Forward and backward of the first rays of each part; the arenas' high-water marks say what they took.
  const auto fits = [&](std::int64_t first) {
    forget_step();
    try {
      sums_->begin(false);
      walk(shape, step, first);
    } catch (const Error& refused) {
      if (refused.kind() != ErrorKind::unavailable) throw;
      return false;
    }
    return true;
  };
  std::int64_t fit = rays / 2;
  while (fit > 0 && !fits(fit)) fit /= 2;
  if (fit == 0) return error;
  const std::size_t taken = train_arena_.high_water_bytes() + beside_arena_.high_water_bytes();
  const double each = static_cast<double>(taken) / static_cast<double>(fit);
  forget_step();
  // An arena asks for an eighth more than its high-water mark (core/workspace.h).
  const double most = kMargin * static_cast<double>(free_bytes()) / (1.125 * each);
  std::int64_t more = std::min(static_cast<std::int64_t>(most), rays) / kRound * kRound;
  while (more > fit && !fits(more)) more = more * 3 / 4 / kRound * kRound;
  fit = std::max(fit, more);
  forget_step();
  drop_gradients();
  if (fit == rays) {
    return {error.kind(), error.code(), error.message(),
            "other processes held the memory and have freed it: start again; or runtime.device: cpu"};
  }
  return {error.kind(), error.code(), error.message(),
          fmt::format("any of these fits: train.rays: {} (now {}); {:.2f} times the samples in every pass; "
                      "runtime.device: cpu",
                      fit * sums_->ranks(), rays_, static_cast<double>(fit) / static_cast<double>(rays))};
}

// The walk of a step on the device: sums go into those of the step, and semantic branches run on a stream of their own.
class StreamExecutor::Walk final : public StepExecutor<float> {
 public:
  Walk(StreamExecutor& owner, const Shape& shape, const StepContext& ctx) : owner_(owner), shape_(shape), ctx_(ctx) {}

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
    count_samples(trace.samples.first, trace.drawn.first, trace.sigma, sums(pass));
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
    if (owner_.cameras_ && pass + 1 == owner_.passes_.size()) owner_.cameras_->derive_backward(ctx_);
    owner_.sums_->pass_done(pass);
  }

 private:
  LossSums* sums(std::size_t pass) const { return &owner_.staging_->device_sums()->pass[pass]; }

  StreamExecutor& owner_;
  const Shape& shape_;
  StepContext ctx_;
  std::optional<LaunchScope> branch_;
};

// The first `most` of this rank's rays.
void StreamExecutor::walk(const Shape& shape, std::int64_t step, std::int64_t most) {
  const RayRange own = sums_->own(rays_);
  const std::int64_t count = std::min(most, own.count);
  if (count == 0) return;
  const Workspace::Scope scope(train_arena_), beside(beside_arena_);
  const RayBatch batch = staging_->batch().rows(0, count);
  StepContext ctx = context(step, true, train_arena_);
  ctx.first_ray = own.begin;
  TrainedRays<float> rays;
  rays.batch = batch;
  rays.cameras = cameras_ ? &*cameras_ : nullptr;
  if (cameras_ && cameras_->rules().poses) {  // rays as their cameras are corrected
    const auto copy = [&](View<const double> from) {
      const View<double> to = train_arena_.take<double>(from.rows, from.cols);
      stages().copy(bytes_of(from), bytes_of(to));
      return to;
    };
    const View<double> origin = copy(batch.origin), direction = copy(batch.direction);
    cameras_->move(batch.targets.more[channel::camera], origin, direction);
    rays.batch.origin = origin;
    rays.batch.direction = direction;
  }
  rays.room = room_.rows();
  rays.reached_room = reached_room_.rows();
  rays.semantic_rays = std::min(shape.semantic_rays, count);
  rays.first_color = batch.without_color();
  Walk executor(*this, shape, ctx);
  train_rays<float>(passes_, host_.per_ray(), rays, ctx, executor);
}

void StreamExecutor::backward(const Shape& shape, std::int64_t step, bool overlapped) {
  StepSums* const sums = staging_->device_sums();
  check(cudaMemsetAsync(sums->pass, 0, sizeof sums->pass, stream_), "clearing sums");
  sums_->begin(overlapped);
  store_->zero_derived_gradients();
  walk(shape, step, tile_rays(rays_));
}

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

StepLosses StreamExecutor::losses_of(std::span<const StepSums* const> sums, const BatchScales& scales) const {
  StepLosses out;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    LossSums pass;
    for (const StepSums* const of_rank : sums) add(pass, of_rank->pass[p]);
    out.color += pass.squares;
    out.semantic += pass.semantic;
    out.mse = pass.squares;
    for (std::size_t i = 0; i < kMostLossTerms; ++i) out.terms[i] += pass.terms[i];
    out.samples = pass.samples;
    out.labelled = pass.labelled;
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
    std::int64_t drawn = 0, samples = 0;
    for (const StepSums& sums : staging_->sums(queued.size())) {
      drawn = std::max(drawn, sums.pass[0].drawn);
      samples = std::max(samples, sums.pass[0].samples);
    }
    const bool changed = room_.saw(drawn);
    if (reached_room_.saw(samples) || changed) {
      forget_graphs();
      forget_step();
    }
  }
  return {done_, failed, std::nullopt};
}

class StreamExecutor::Points final : public PointNetwork<float> {
 public:
  explicit Points(StreamExecutor& owner)
      : owner_(owner), pass_(owner.passes_.back()), sums_(1, "sums of learning from points") {}

  void rows(View<const double> positions, View<float> rows) override {
    over_points(
        positions.rows,
        [&](const StepContext& ctx, std::int64_t begin, std::int64_t count) {
          const View<float> wanted = rows.row_range(begin, count), found = ends().room_for(wanted);
          pass_.point_rows(ctx, ends().sent(positions.row_range(begin, count)), found);
          ends().fetch(found, wanted);
        },
        [&] { on_the_host().rows(positions, rows); });
  }

  void logits(View<const float> rows, View<float> logits) override {
    over_points(
        rows.rows,
        [&](const StepContext& ctx, std::int64_t begin, std::int64_t count) {
          const View<float> wanted = logits.row_range(begin, count), found = ends().room_for(wanted);
          (void)pass_.point_forward(ctx, kMainGradient, ends().sent(rows.row_range(begin, count)), found);
          ends().fetch(found, wanted);
        },
        [&] { on_the_host().logits(rows, logits); });
  }

  void learn(const PointLessons<float>& lessons) override {
    const LaunchScope scope(owner_.begin_call());
    const Workspace::Scope taken(owner_.render_arena_);
    owner_.store_->upload(true);
    const Lesson lesson{ends().sent(lessons.rows), ends().sent(column(lessons.logit)),
                        ends().sent(column(lessons.choice)), lessons.batch,
                        owner_.store_->semantic(lessons.weight_decay)};
    const std::vector<StepCell> cells = cells_of(lessons);
    const Buffer<StepCell> cells_there(cells.size(), "steps of learning from points");
    cuda::upload<StepCell>(cells, cells_there.data());
    for (std::size_t n = 0; n < cells.size(); ++n) {
      Launch next = launch();
      next.cell = cells_there.data() + n;
      next.deterministic = owner_.options_.deterministic;
      const LaunchScope of_step(next);
      learn_once(lesson, static_cast<std::int64_t>(n));
    }
    pass_.derive(context(false));
    owner_.explain_fault([&] { on_the_host().learn(lessons); });
    owner_.store_->download(true);
    for (const Tensor<float>* tensor : semantic_tensors(owner_.host_.store())) {
      std::fill_n(tensor->moment1.data(), tensor->moment1.size(), 0.0F);
      std::fill_n(tensor->moment2.data(), tensor->moment2.size(), 0.0F);
    }
    owner_.store_->upload(true);
  }

  void read() override {
    const LaunchScope scope(owner_.begin_call());
    owner_.store_->download(true);
  }

  void write() override {
    const LaunchScope scope(owner_.begin_call());
    owner_.store_->upload(true);
    pass_.derive(context(false));
    synchronize();
  }

 private:
  // Points to learn from, and the tensors that learn, in device memory.
  struct Lesson {
    View<const float> rows;
    View<const std::int16_t> logit;
    View<const std::int32_t> choice;
    std::int64_t batch;
    AdamTable<float> tensors;
  };

  PointNetwork<float>& on_the_host() const { return owner_.host_.lanes().points(); }
  HostEnds<float> ends() const { return {stages(), owner_.render_arena_}; }
  StepContext context(bool training) const {
    StepContext ctx = owner_.context(0, training, owner_.render_arena_);
    ctx.pass = pass_.parts().number;
    return ctx;
  }
  // A chunk at a time, waited for at its end.
  template <class Call>
  void over_points(std::int64_t points, const Call& call, const std::function<void()>& explain) const {
    const LaunchScope scope(owner_.begin_call());
    for (std::int64_t first = 0; first < points; first += kChunkPoints) {
      const Workspace::Scope chunk(owner_.render_arena_);
      call(context(false), first, std::min(kChunkPoints, points - first));
      synchronize();
    }
    owner_.explain_fault(explain);
  }

  // Kernels read the number of the step and its update in launch().cell.
  void learn_once(const Lesson& lesson, std::int64_t step) const {
    Workspace& arena = owner_.render_arena_;
    const Workspace::Scope taken(arena);
    const StepContext ctx = context(true);
    pass_.derive(ctx);
    owner_.store_->zero_derived_gradients();
    const View<float> input = arena.take<float>(lesson.batch, lesson.rows.cols);
    const View<std::int16_t> truth = arena.take<std::int16_t>(lesson.batch, 1);
    choose_points(lesson.choice.row_range(step * lesson.batch, lesson.batch), lesson.rows, lesson.logit, input, truth);
    const std::int32_t classes = pass_.parts().head->width();
    const View<float> logits = arena.take<float>(lesson.batch, classes);
    const View<float> d_logits = arena.take<float>(lesson.batch, classes);
    const PointTrace<float> trace = pass_.point_forward(ctx, kMainGradient, input, logits);
    SemanticTargets targets;
    targets.hard = truth;
    semantic_cross_entropy(arena, logits, targets, {}, 1, d_logits, sums_.data());
    pass_.point_backward(ctx, kMainGradient, trace, d_logits);
    pass_.derive_backward(ctx);
    stages().adam(&launch().cell->adam, lesson.tensors);
  }

  StreamExecutor& owner_;
  const Pass<float>& pass_;
  Buffer<LossSums> sums_;
};

PointNetwork<float>& StreamExecutor::points() {
  if (!points_) {
    const LaunchScope scope(begin_call());
    points_ = std::make_unique<Points>(*this);
  }
  return *points_;
}

Launch StreamExecutor::begin_call() const {
  const Launch next{.ordinal = options_.ordinal, .stream = stream_, .fault = render_fault_.data()};
  const LaunchScope scope(next);
  check(cudaMemsetAsync(next.fault, 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  return next;
}

void StreamExecutor::render(const RenderJob<float>& job) {
  guard_rays<float>({job.origin, job.direction, job.near_far}, {}, 0);
  const LaunchScope scope(begin_call());
  for (std::int64_t begin = 0; begin < job.origin.rows;) {
    const std::int64_t count = std::min(chunk_rays_, job.origin.rows - begin);
    try {
      const Workspace::Scope chunk(render_arena_);
      StepContext ctx = context(0, false, render_arena_);
      ctx.first_ray = begin;
      render_rays(passes_, host_.rendered_per_ray(), job.rows(begin, count), ctx);
      synchronize();
    } catch (const Error& error) {
      if (error.kind() != ErrorKind::unavailable || chunk_rays_ <= kFewestRays) throw;
      chunk_rays_ /= 2;
      synchronize();
      render_arena_.forget();
      continue;
    }
    begin += count;
  }
  explain_fault([&] { host_.lanes().render(job); });
}

void StreamExecutor::density(View<const double> positions, View<float> sigma) {
  const LaunchScope scope(begin_call());
  for (std::int64_t begin = 0; begin < positions.rows; begin += kChunkPositions) {
    const Workspace::Scope chunk(render_arena_);
    const std::int64_t count = std::min(kChunkPositions, positions.rows - begin);
    query_density(passes_.back(), positions.row_range(begin, count), sigma.row_range(begin, count),
                  context(0, false, render_arena_));
  }
  explain_fault([&] { host_.lanes().density(positions, sigma); });
}

// A value that is not finite: the CPU makes the call again and names ray and stage.
void StreamExecutor::explain_fault(const std::function<void()>& on_the_host) {
  FaultKey key = kNoFault;
  cuda::download<FaultKey>(render_fault_.data(), {&key, 1});
  synchronize();
  if (key == kNoFault) return;
  download(0);
  on_the_host();
  throw Error(ErrorKind::failure, "device.value.not_finite",
              fmt::format("the device met a value that is not finite (stage {}, row {}) where the CPU meets none",
                          key >> kFaultRowBits, key & ((FaultKey{1} << kFaultRowBits) - 1)),
              "set runtime.precision: fp32 or runtime.device: cpu, and report this");
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
  static const semfield::DeviceLibrary library{
      add_kernels, &semfield::cuda::stages(),      describe,
      make,        semfield::cuda::device_calls(), semfield::cuda::learn_grouping};
  return &library;
}
