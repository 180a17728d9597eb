#include "execution/ranks_executor.h"

#include <algorithm>
#include <cstdlib>
#include <set>
#include <type_traits>

#include "core/check.h"
#include "core/checksum.h"
#include "core/view.h"
#include "execution/lane_executor.h"

namespace semfield {

namespace {

// Rows that lie behind each other; a root's are only read.
template <class T>
std::span<std::byte> memory_of(const View<T>& view) {
  SEMFIELD_CHECK(view.contiguous(), "rows that ranks share lie behind each other");
  auto* const data = const_cast<std::remove_const_t<T>*>(view.data);
  return std::as_writable_bytes(std::span(data, static_cast<std::size_t>(view.size())));
}

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

}  // namespace

template <class Real>
LaneRanks<Real>::LaneRanks(Ranks& ranks, int lanes) : ranks_(&ranks), lanes_(lanes) {}

// Rank r begins with the lane before which there are as near to r / size of all tiles as can be.
template <class Real>
void LaneRanks<Real>::share_out(std::int64_t tiles) {
  const std::int64_t each = tiles / lanes_, more = tiles % lanes_;
  first_.assign(static_cast<std::size_t>(ranks_->size()) + 1, lanes_);
  int lane = 0;
  for (int rank = 0; rank < ranks_->size(); ++rank) {
    const auto off = [&](std::int64_t l) {  // tiles too many or too few, times the number of ranks
      return std::abs((l * each + std::min(l, more)) * ranks_->size() - tiles * rank);
    };
    while (lane < lanes_ && off(lane + 1) < off(lane)) ++lane;
    first_[static_cast<std::size_t>(rank)] = lane;
  }
}

template <class Real>
void LaneRanks<Real>::gather_losses(std::vector<StepLosses>& tiles) {
  static_assert(std::is_trivially_copyable_v<StepLosses>);
  const auto count = std::ssize(tiles);
  // Of a rank its lanes in order, of a lane its tiles.
  const auto each_of = [&](int rank, const auto& body) {
    for (int lane = first_of(rank); lane < first_of(rank + 1); ++lane) {
      for (std::int64_t tile = lane; tile < count; tile += lanes_) body(tiles[static_cast<std::size_t>(tile)]);
    }
  };
  std::vector<StepLosses> own, all;
  each_of(ranks_->rank(), [&](const StepLosses& losses) { own.push_back(losses); });
  join_values<StepLosses>(*ranks_, own, all);
  std::size_t next = 0;
  for (int r = 0; r < ranks_->size(); ++r) each_of(r, [&](StepLosses& losses) { losses = all[next++]; });
}

template <class Real>
EncodedRows<Real> LaneRanks<Real>::gather_rows(const EncodedRows<Real>& own) {
  const auto values = [](const auto& view) { return std::span(view.data, static_cast<std::size_t>(view.size())); };
  join_values<double>(*ranks_, values(own.x), x_);
  join_values<Real>(*ranks_, values(own.d_encoded), d_encoded_);
  const std::int64_t total = std::ssize(x_) / 3;
  return {{x_.data(), total, 3}, {d_encoded_.data(), total, own.d_encoded.cols}};
}

template <class Real>
void LaneRanks<Real>::share_rows(View<Real> column, const std::function<void(std::int64_t, std::int64_t)>& compute) {
  const auto [begin, end] = part_of(column.rows, ranks_->rank(), ranks_->size());
  agree(*ranks_, [&, first = begin, last = end] { compute(first, last); });
  std::vector<Real> own, all;
  for (std::int64_t r = begin; r < end; ++r) own.push_back(*column.row(r));
  join_values<Real>(*ranks_, own, all);
  for (std::int64_t r = 0; r < column.rows; ++r) *column.row(r) = all[static_cast<std::size_t>(r)];
}

template <class Real>
void LaneRanks<Real>::sum_lanes(ParamStore<Real>& store) {
  const int rank = ranks_->rank(), last = ranks_->size() - 1;
  const auto each = [&](const auto& exchange) {
    for (const Tensor<Real>& t : store.all())
      if (t.lanes.size() > 0) exchange(std::as_writable_bytes(std::span(t.grad.data(), t.grad.size())));
  };
  if (rank > 0) each([&](std::span<std::byte> sums) { ranks_->receive(rank - 1, sums); });
  store.reduce_lanes(first(), end());
  if (rank < last) each([&](std::span<std::byte> sums) { ranks_->send(rank + 1, sums); });
  each([&](std::span<std::byte> sums) { ranks_->broadcast(sums, last); });
}

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
        case Task::density:
          share(order, {});
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

void RanksExecutor::render(const RenderJob<float>& job) {
  if (job.heads.size() > 0) return inner_.render(job);  // names of channels do not travel
  lead_job({.task = Task::render, .footprint_per_m = job.footprint_per_m}, job);
}

void RanksExecutor::density(View<const double> positions, View<float> sigma) {
  RenderJob<float> job;
  job.origin = positions;
  job.opacity = sigma;
  lead_job({.task = Task::density}, job);
}

void RanksExecutor::lead_job(Order order, RenderJob<float> job) {
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
// the others gets memory here. Where densities are asked for, its origins are the positions, and they are its opacity.
void RanksExecutor::share(const Order& order, RenderJob<float> job) {
  job.footprint_per_m = order.footprint_per_m;
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
  const RenderJob<float> own = job.rows(first, last - first);
  agree(ranks_, [&] {
    if (own.origin.rows == 0) return;
    if (order.task == Task::density) return inner_.density(own.origin, own.opacity);
    inner_.render(own);
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

template class LaneRanks<float>;
template class LaneRanks<double>;

}  // namespace semfield
