#include "execution/ranks_executor.h"

#include <algorithm>
#include <cstddef>
#include <set>
#include <type_traits>

#include "core/check.h"
#include "core/view.h"
#include "execution/lane_executor.h"
#include "system/checksum.h"

namespace semfield {

namespace {

// Rows that lie behind each other; a root's are only read.
template <class T>
std::span<std::byte> memory_of(const View<T>& view) {
  SEMFIELD_CHECK(view.contiguous(), "rows that ranks share lie behind each other");
  auto* const data = const_cast<std::remove_const_t<T>*>(view.data);
  return std::as_writable_bytes(std::span(data, static_cast<std::size_t>(view.size())));
}

// A question for densities, as a job.
struct Positions {
  View<const double> origin;
  View<float> sigma;
  Positions rows(std::int64_t begin, std::int64_t count) const {
    return {origin.row_range(begin, count), sigma.row_range(begin, count)};
  }
};

void run(Executor<float>& executor, const RenderJob<float>& job) { executor.render(job); }
void run(Executor<float>& executor, const Positions& job) { executor.density(job.origin, job.sigma); }

// visit(array) for those that a job is given, and for those that it fills.
template <class Visit>
void each_input(RenderJob<float>& job, const Visit& visit) {
  visit(job.origin), visit(job.direction), visit(job.near_far), visit(job.truth);
}
template <class Visit>
void each_output(RenderJob<float>& job, const Visit& visit) {
  visit(job.color), visit(job.depth), visit(job.opacity), visit(job.entropy), visit(job.confidence);
  visit(job.truth_probability), visit(job.probability), visit(job.label), visit(job.resolution);
}
template <class Visit>
void each_input(Positions& job, const Visit& visit) {
  visit(job.origin);
}
template <class Visit>
void each_output(Positions& job, const Visit& visit) {
  visit(job.sigma);
}

}  // namespace

RanksExecutor::RanksExecutor(Ranks& ranks, Pipeline<float>& pipeline, std::unique_ptr<Executor<float>> device)
    : ranks_(ranks), pipeline_(pipeline), device_(std::move(device)), inner_(device_ ? *device_ : pipeline.lanes()) {
  if (!device_) pipeline.lanes().share_with(ranks);
}

RanksExecutor::~RanksExecutor() {
  if (!leads() || ranks_.lost()) return;
  try {
    tell({});
  } catch (const RankLost&) {  // there is nobody left to tell
  }
}

std::string RanksExecutor::description() const {
  std::set<std::string> hosts;
  for (int r = 0; r < ranks_.size(); ++r) {
    const std::string& name = ranks_.name_of(r);
    hosts.insert(name.substr(name.rfind(' ') + 1));
  }
  return inner_.description() + ", " + std::to_string(ranks_.size()) + " processes on " + std::to_string(hosts.size()) +
         (hosts.size() == 1 ? " host" : " hosts");
}

void RanksExecutor::tell(const Order& order) {
  Order told = order;
  ranks_.broadcast(std::as_writable_bytes(std::span(&told, 1)));
}

void RanksExecutor::serve() {
  for (;;) {
    Order order;
    ranks_.broadcast(std::as_writable_bytes(std::span(&order, 1)));
    try {
      switch (order.task) {
        case Task::end:
          return;
        case Task::upload:
          share_tensors();
          inner_.upload(order.step);
          break;
        case Task::compare:
          inner_.download(order.step);
          compare_tensors();
          break;
        case Task::queue:
          serve_step(order);
          break;
        case Task::finish:
          (void)inner_.finish();
          break;
        case Task::render:
          share(order, RenderJob<float>{});
          break;
        case Task::density:
          share(order, Positions{});
          break;
      }
    } catch (const RankLost&) {
      throw;
    } catch (const Error&) {  // rank 0 has met it too, and says so
      pipeline_.store().clear_gradients();
    }
  }
}

void RanksExecutor::upload(std::int64_t step) {
  tell({.task = Task::upload, .step = step});
  share_tensors();
  inner_.upload(step);
}

void RanksExecutor::share_tensors() {
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!is_stored(t.spec.role)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2})
      ranks_.broadcast(std::as_writable_bytes(std::span(buffer->data(), buffer->size())));
  }
}

void RanksExecutor::download(std::int64_t step) {
  if (ranks_.lost()) return inner_.download(step);
  tell({.task = Task::compare, .step = step});
  inner_.download(step);
  compare_tensors();
}

// Every rank updates its own tensors, from the same sums: what differs is a fault of a machine or of a program.
void RanksExecutor::compare_tensors() {
  std::uint32_t crc = 0;
  for (const Tensor<float>& t : pipeline_.store().all()) {
    if (!is_stored(t.spec.role)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2})
      crc = crc32c(std::as_bytes(std::span(buffer->data(), buffer->size())), crc);
  }
  const std::vector<std::uint32_t> all = all_of(ranks_, crc);
  const auto other = std::find_if(all.begin(), all.end(), [&](std::uint32_t sum) { return sum != all.front(); });
  if (other == all.end()) return;
  const auto rank = static_cast<int>(other - all.begin());
  throw Error(
      ErrorKind::failure, "ranks.tensors.differ",
      "the tensors of " + ranks_.name_of(rank) + " are no longer those of " + ranks_.name_of(0),
      "resume from the last checkpoint; if it happens again, a machine computes wrongly, or is of another kind");
}

void RanksExecutor::queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) {
  tell({.task = Task::queue, .terms = batch.terms, .step = step, .update = update, .shape = shape_of(batch)});
  const BatchLayout layout(batch);
  message_.resize(layout.bytes());
  layout.write(batch, message_.data());
  ranks_.broadcast(message_);
  label_only_.assign(batch.label_only.data, batch.label_only.data + batch.label_only.rows);
  ranks_.broadcast(std::as_writable_bytes(std::span(label_only_)));
  inner_.queue(step, batch, update);
}

void RanksExecutor::serve_step(const Order& order) {
  const BatchLayout layout(order.shape.batch());
  message_.resize(layout.bytes());
  ranks_.broadcast(message_);
  label_only_.resize(static_cast<std::size_t>(order.shape.tiles));
  ranks_.broadcast(std::as_writable_bytes(std::span(label_only_)));
  RayBatch batch = layout.in(message_.data(), Device::cpu);
  if (!label_only_.empty()) batch.label_only = {label_only_.data(), order.shape.tiles, 1};
  batch.terms = order.terms;
  inner_.queue(order.step, batch, order.update);
}

StepResults RanksExecutor::finish() {
  try {
    tell({.task = Task::finish});
  } catch (const RankLost&) {
    if (device_) throw;  // the lanes have made all that was queued, so that the last step counts
  }
  return inner_.finish();
}

void RanksExecutor::set_gradient_hook(GradientHook<float> hook) {
  if (hook)
    throw Error(ErrorKind::usage, "ranks.hook.single", "a gradient hook sees the gradients of one process",
                "train in one process");
}

void RanksExecutor::render(const RenderJob<float>& job) {
  if (job.heads.size() > 0) return inner_.render(job);  // names of channels do not travel
  lead_job({.task = Task::render, .footprint_per_m = job.footprint_per_m}, job);
}

void RanksExecutor::density(View<const double> positions, View<float> sigma) {
  lead_job({.task = Task::density}, Positions{positions, sigma});
}

template <class Job>
void RanksExecutor::lead_job(Order order, Job job) {
  order.rows = job.origin.rows;
  if (order.rows == 0) return;
  std::size_t next = 0;
  const auto note = [&](const auto& view) { order.cols.at(next++) = view.empty() ? 0 : view.cols; };
  each_input(job, note);
  each_output(job, note);
  tell(order);
  share(order, job);
}

// Rank 0's rays reach all, each answers for its part of them, and rank 0 gets the answers. `job` is rank 0's; that of
// the others gets memory here.
template <class Job>
void RanksExecutor::share(const Order& order, Job job) {
  if constexpr (requires { job.footprint_per_m; }) job.footprint_per_m = order.footprint_per_m;
  std::vector<std::vector<std::byte>> memory;
  std::size_t next = 0;
  const auto make_room = [&]<class T>(View<T>& view) {
    const std::int32_t cols = order.cols.at(next++);
    if (leads() || cols == 0) return;
    memory.emplace_back(static_cast<std::size_t>(order.rows * cols) * sizeof(T));
    view = View<T>(reinterpret_cast<T*>(memory.back().data()), order.rows, cols);
  };
  each_input(job, make_room);
  each_output(job, make_room);
  each_input(job, [&](const auto& view) {
    if (!view.empty()) ranks_.broadcast(memory_of(view));
  });
  const auto [first, last] = part_of(order.rows, ranks_.rank(), ranks_.size());
  const Job own = job.rows(first, last - first);
  agree(ranks_, [&] {
    if (own.origin.rows > 0) run(inner_, own);
  });
  each_output(job, [&](const auto& view) {
    if (view.empty()) return;
    const auto bytes = [&](int rank) {
      const auto [begin, end] = part_of(order.rows, rank, ranks_.size());
      return memory_of(view.row_range(begin, end - begin));
    };
    if (!leads()) return ranks_.send(0, bytes(ranks_.rank()));
    for (int r = 1; r < ranks_.size(); ++r) ranks_.receive(r, bytes(r));
  });
}

}  // namespace semfield
