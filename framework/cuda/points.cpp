// The semantic part at points of space: what it reads there, its logits, and steps of learning from points.
#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "cuda/stages.h"
#include "cuda/stream_executor.h"
#include "execution/lane_executor.h"

namespace semfield::cuda {

namespace {

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

}  // namespace

class StreamExecutor::Points final : public PointNetwork<float> {
 public:
  explicit Points(StreamExecutor& owner)
      : owner_(owner), pass_(owner.passes_.back()), sums_(sizeof(LossSums), "sums of learning from points") {}

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
    const LaunchScope scope(begin());
    const Workspace::Scope taken(owner_.render_arena_);
    owner_.store_->upload_semantic();
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
    owner_.store_->download_semantic();
    for (const Tensor<float>* tensor : semantic_tensors(owner_.host_.store())) {
      std::fill_n(tensor->moment1.data(), tensor->moment1.size(), 0.0F);
      std::fill_n(tensor->moment2.data(), tensor->moment2.size(), 0.0F);
    }
    owner_.store_->upload_semantic();
  }

  void read() override {
    const LaunchScope scope(begin());
    owner_.store_->download_semantic();
  }

  void write() override {
    const LaunchScope scope(begin());
    owner_.store_->upload_semantic();
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
  Launch begin() const {
    const Launch next = owner_.render_launch();
    const LaunchScope scope(next);
    check(cudaMemsetAsync(next.fault, 0xFF, sizeof(FaultKey), next.stream), "resetting a fault");
    return next;
  }

  // A chunk at a time, waited for at its end.
  template <class Call>
  void over_points(std::int64_t points, const Call& call, const std::function<void()>& explain) const {
    const LaunchScope scope(begin());
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
    semantic_cross_entropy(arena, logits, targets, {}, 1, d_logits, reinterpret_cast<LossSums*>(sums_.data()));
    pass_.point_backward(ctx, kMainGradient, trace, d_logits);
    pass_.derive_backward(ctx);
    stages().adam(&launch().cell->adam, lesson.tensors);
  }

  StreamExecutor& owner_;
  const Pass<float>& pass_;
  Buffer<std::byte> sums_;
};

PointNetwork<float>& StreamExecutor::points() {
  if (!points_) {
    const LaunchScope scope(render_launch());
    points_ = std::make_unique<Points>(*this);
  }
  return *points_;
}

// Rendering and density queries: a batch is cut into chunks, whose results are waited for at the end.

namespace {

constexpr std::int64_t kFewestRays = 256;
constexpr std::int64_t kChunkPositions = std::int64_t{1} << 20;

}  // namespace

Launch StreamExecutor::render_launch() const {
  Launch next;
  next.ordinal = options_.ordinal;
  next.stream = stream_;
  next.fault = render_fault_.data();
  return next;
}

void StreamExecutor::render(const RenderJob<float>& job) {
  guard_rays<float>({job.origin, job.direction, job.near_far}, {}, 0);
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
  for (std::int64_t begin = 0; begin < job.origin.rows;) {
    const std::int64_t count = std::min(chunk_rays_, job.origin.rows - begin);
    try {
      const Workspace::Scope chunk(render_arena_);
      StepContext ctx = context(0, false, render_arena_);
      ctx.first_ray = begin;
      render_rays(passes_, host_.per_ray(), job.rows(begin, count), ctx);
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
  const LaunchScope scope(render_launch());
  check(cudaMemsetAsync(render_fault_.data(), 0xFF, sizeof(FaultKey), stream_), "resetting a fault");
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
