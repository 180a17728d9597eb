#include "execution/ranks_executor.h"

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <set>
#include <type_traits>

#include "core/check.h"
#include "core/view.h"
#include "execution/lane_executor.h"
#include "system/checksum.h"

namespace semfield {

/// A message in `bytes`, which it begins anew. Whoever sends adds everything; whoever receives expects everything,
/// fills the bytes, and takes everything in the same order. Arrays with larger elements come before those with smaller
/// ones, so that each is aligned.
class ArrayMessage {
 public:
  explicit ArrayMessage(std::vector<std::byte>& bytes) : bytes_(bytes) { bytes_.clear(); }

  template <class T, class = std::enable_if_t<std::is_trivially_copyable_v<T>>>
  void add(const T& value) {
    append(&value, sizeof value);
  }
  template <class T>
  void add(const View<T>& view) {
    if (view.empty()) return;
    for (std::int64_t r = 0; r < view.rows; ++r) append(view.row(r), static_cast<std::size_t>(view.cols) * sizeof(T));
  }

  template <class T>
  void expect(const T&) {
    bytes_.resize(bytes_.size() + sizeof(T));
  }
  template <class T>
  void expect(const View<T>&, std::int64_t rows, std::int32_t cols) {
    bytes_.resize(bytes_.size() + size_of<T>(rows, cols));
  }

  template <class T>
  void take(T& value) {
    std::memcpy(&value, bytes_.data() + at_, sizeof value);
    at_ += sizeof value;
  }
  /// Into the message's bytes, which must outlive the view.
  template <class T>
  View<T> take(const View<T>&, std::int64_t rows, std::int32_t cols) {
    const View<T> view(reinterpret_cast<T*>(bytes_.data() + at_), rows, cols);
    at_ += size_of<T>(rows, cols);
    return view;
  }
  template <class T>
  void copy_into(const View<T>& to, std::int64_t rows, std::int32_t cols) {
    const View<T> from = take(to, rows, cols);
    for (std::int64_t r = 0; r < rows; ++r)
      std::memcpy(to.row(r), from.row(r), static_cast<std::size_t>(cols) * sizeof(T));
  }

 private:
  template <class T>
  static std::size_t size_of(std::int64_t rows, std::int32_t cols) {
    return static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * sizeof(T);
  }
  void append(const void* data, std::size_t size) {
    const std::size_t begin = bytes_.size();
    bytes_.resize(begin + size);
    std::memcpy(bytes_.data() + begin, data, size);
  }

  std::vector<std::byte>& bytes_;
  std::size_t at_ = 0;
};

namespace {

template <class T>
std::span<std::byte> bytes_of(T& value) {
  static_assert(std::is_trivially_copyable_v<T>);
  return std::as_writable_bytes(std::span(&value, 1));
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

// The arrays of a job, those with the largest elements first; `visit` gets each and its columns.
template <class Job, class Visit>
void each_input(Job& job, const Visit& visit) {
  visit(job.origin, 3);
  if constexpr (requires { job.direction; }) {
    visit(job.direction, 3);
    visit(job.near_far, 2);
    visit(job.truth, 1);
  }
}
template <class Job, class Visit>
void each_output(Job& job, std::int32_t logits, const Visit& visit) {
  if constexpr (requires { job.sigma; }) {
    visit(job.sigma, 1);
  } else {
    visit(job.color, 3);
    visit(job.depth, 1);
    visit(job.opacity, 1);
    visit(job.entropy, 1);
    visit(job.confidence, 1);
    visit(job.truth_probability, 1);
    visit(job.probability, logits);
    visit(job.label, 1);
    visit(job.resolution, 1);
  }
}

// Bit i: the i-th array is there.
template <class Job>
std::uint32_t arrays_there(const Job& job) {
  std::uint32_t wanted = 0, bit = 1;
  const auto look = [&](const auto& view, std::int32_t) {
    if (!view.empty()) wanted |= bit;
    bit <<= 1;
  };
  each_input(job, look);
  each_output(job, 0, look);
  return wanted;
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
  ranks_.broadcast(bytes_of(told));
}

void RanksExecutor::serve() {
  for (;;) {
    Order order;
    ranks_.broadcast(bytes_of(order));
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
  tell({.task = Task::queue, .terms = batch.terms, .step = step, .shape = shape_of(batch)});
  ArrayMessage message(message_);
  message.add(update);
  message.add(batch.label_only);
  each_array(batch, [&](const auto& view) { message.add(view); });
  ranks_.broadcast(message_);
  inner_.queue(step, batch, update);
}

void RanksExecutor::serve_step(const Order& order) {
  AdamStep update;
  RayBatch batch = order.shape.batch();
  batch.terms = order.terms;
  ArrayMessage message(message_);
  const auto each = [&](const auto& visit) {
    if (order.shape.tiles > 0) visit(batch.label_only, order.shape.tiles, 1);
    each_array(batch, [&](auto& view) {
      if (view.cols > 0) visit(view, order.shape.rays, view.cols);
    });
  };
  message.expect(update);
  each([&](auto& view, std::int64_t rows, std::int32_t cols) { message.expect(view, rows, cols); });
  ranks_.broadcast(message_);
  message.take(update);
  each([&](auto& view, std::int64_t rows, std::int32_t cols) { view = message.take(view, rows, cols); });
  inner_.queue(order.step, batch, update);
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
  const Order order{.task = Task::render,
                    .cols = job.probability.cols,
                    .wanted = arrays_there(job),
                    .rows = job.origin.rows,
                    .footprint_per_m = job.footprint_per_m};
  tell(order);
  share(order, job);
}

void RanksExecutor::density(View<const double> positions, View<float> sigma) {
  const Positions job{positions, sigma};
  const Order order{.task = Task::density, .wanted = arrays_there(job), .rows = positions.rows};
  tell(order);
  share(order, job);
}

// Rank 0 sends the others their rows and gets their results; `whole` is rank 0's alone.
template <class Job>
void RanksExecutor::share(const Order& order, const Job& whole) {
  const auto part = [&](int rank) { return part_of(order.rows, rank, ranks_.size()); };
  const auto [begin, end] = part(ranks_.rank());
  std::vector<std::byte> results;
  Job own;
  if constexpr (requires { own.footprint_per_m; }) own.footprint_per_m = order.footprint_per_m;
  std::uint32_t bit = 1;
  const auto wanted = [&](const auto& visit) {
    return [&](auto& view, std::int32_t cols) {
      if ((order.wanted & bit) != 0) visit(view, cols);
      bit <<= 1;
    };
  };
  if (leads()) {
    own = whole.rows(begin, end - begin);
    for (int r = 1; r < ranks_.size(); ++r) {
      const Job theirs = whole.rows(part(r).first, part(r).second - part(r).first);
      ArrayMessage message(message_);
      each_input(theirs, [&](const auto& view, std::int32_t) { message.add(view); });
      ranks_.send(r, message_);
    }
  } else {
    ArrayMessage message(message_);
    each_input(own, wanted([&](auto& view, std::int32_t cols) { message.expect(view, end - begin, cols); }));
    const std::uint32_t outputs = bit;
    ranks_.receive(0, message_);
    bit = 1;
    each_input(own, wanted([&](auto& view, std::int32_t cols) { view = message.take(view, end - begin, cols); }));
    ArrayMessage room(results);
    bit = outputs;
    each_output(own, order.cols, wanted([&](auto& view, std::int32_t cols) { room.expect(view, end - begin, cols); }));
    bit = outputs;
    each_output(own, order.cols,
                wanted([&](auto& view, std::int32_t cols) { view = room.take(view, end - begin, cols); }));
  }
  agree(ranks_, [&, any = end > begin] {
    if (any) run(inner_, own);
  });
  if (!leads()) return ranks_.send(0, results);
  for (int r = 1; r < ranks_.size(); ++r) {
    const std::int64_t first = part(r).first, count = part(r).second - first;
    Job theirs = whole.rows(first, count);
    ArrayMessage message(message_);
    const auto each = [&](const auto& visit) {
      each_output(theirs, order.cols, [&](auto& view, std::int32_t cols) {
        if (!view.empty()) visit(view, cols);
      });
    };
    each([&](auto& view, std::int32_t cols) { message.expect(view, count, cols); });
    ranks_.receive(r, message_);
    each([&](auto& view, std::int32_t cols) { message.copy_into(view, count, cols); });
  }
}

}  // namespace semfield
