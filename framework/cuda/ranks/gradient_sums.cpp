#include "cuda/ranks/gradient_sums.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield::cuda {

GradientSums::GradientSums(const DeviceOptions& options, std::span<float> gradients, std::vector<std::size_t> ends)
    : ranks_(options.trainable ? options.ranks : nullptr),
      deterministic_(options.deterministic),
      shards_(deterministic_ ? kShards : ranks()),
      gradients_(gradients),
      ends_(std::move(ends)) {
  if (ranks_ == nullptr) return;
  check(cudaStreamCreateWithFlags(&between_, cudaStreamNonBlocking), "making a stream");
  check(cudaEventCreateWithFlags(&walked_, cudaEventDisableTiming), "making an event");
  check(cudaEventCreateWithFlags(&summed_, cudaEventDisableTiming), "making an event");
}

// The exchange goes first: a sum that waits for a rank that has ended is given up with it.
GradientSums::~GradientSums() {
  exchange_.reset();
  if (ranks_ == nullptr) return;
  (void)cudaStreamSynchronize(between_);
  (void)cudaEventDestroy(summed_);
  (void)cudaEventDestroy(walked_);
  (void)cudaStreamDestroy(between_);
}

std::pair<int, int> GradientSums::own_of(int rank) const {
  const auto [begin, end] = part_of(shards_, rank, ranks());
  return {static_cast<int>(begin), static_cast<int>(end)};
}

int GradientSums::lanes_of(const DeviceOptions& options) {
  return options.trainable && options.deterministic ? kShards : 0;
}

void GradientSums::join() {
  if (ranks_ == nullptr || exchange_) return;
  if (deterministic_ && ranks() > 1) {
    throw Error(ErrorKind::config, "ranks.deterministic.several",
                fmt::format("runtime.deterministic gives the bits of one GPU, and this run has {} processes", ranks()),
                "start one process, or set runtime.deterministic: false");
  }
  std::string why_not;
  exchange_ = meet_ranks(*ranks_, why_not);
  if (!why_not.empty())
    notes_.push_back("gradients meet in the host's memory, which takes longer than NCCL: " + why_not);
}

void GradientSums::reserve() {
  if (!exchange_ || deterministic_) return;
  std::size_t most = 0, begin = 0;
  for (const std::size_t end : ends_) {
    most = std::max(most, end - begin);
    begin = end;
  }
  exchange_->reserve(most);
}

void GradientSums::agree(const std::function<void()>& work) {
  if (ranks_ == nullptr) return work();
  semfield::agree(*ranks_, [&] {
    if (pending_) throw Error(*std::exchange(pending_, std::nullopt));
    work();
  });
}

void GradientSums::afterwards(const std::function<void()>& work) {
  if (ranks_ == nullptr) return work();
  try {
    work();
  } catch (const RankLost&) {
    throw;
  } catch (const Error& error) {
    if (!waits()) throw RankLost(error.kind(), error.code(), error.message(), error.remedy());
    pending_ = error;
  }
}

void GradientSums::begin(bool overlapped) {
  overlapped_ = overlapped && exchange_ && exchange_->queues() && !deterministic_;
  next_pass_ = 0;
}

// The last pass is meet's: with it goes the fault, which a later stage may still note.
void GradientSums::pass_done(std::size_t pass) {
  if (!overlapped_ || pass + 1 >= ends_.size()) return;
  sum_pass(pass, nullptr);
  next_pass_ = pass + 1;
}

// All sums are queued on one stream, in the same order on every rank, whether they overlap or not.
void GradientSums::sum_pass(std::size_t pass, FaultKey* fault) {
  const std::size_t begin = pass == 0 ? 0 : ends_[pass - 1];
  const std::span<float> block = gradients_.subspan(begin, ends_[pass] - begin);
  if (block.empty() && fault == nullptr) return;
  check(cudaEventRecord(walked_, launch().stream), "marking a pass");
  check(cudaStreamWaitEvent(between_, walked_, 0), "waiting for a pass");
  exchange_->sum(block, fault, between_);
}

void GradientSums::meet(FaultKey* fault) {
  if (!exchange_ || deterministic_) return;
  for (std::size_t p = next_pass_; p < ends_.size(); ++p) sum_pass(p, p + 1 == ends_.size() ? fault : nullptr);
  check(cudaEventRecord(summed_, between_), "marking a sum");
  check(cudaStreamWaitEvent(launch().stream, summed_, 0), "waiting for a sum");
}

void GradientSums::wait() {
  if (exchange_) return exchange_->wait(launch().stream);
  synchronize();
}

std::vector<StepSums> GradientSums::of_all_ranks(std::span<const StepSums> mine) const {
  std::vector<StepSums> all(mine.size() * static_cast<std::size_t>(ranks()));
  if (ranks_ == nullptr) {
    std::copy(mine.begin(), mine.end(), all.begin());
    return all;
  }
  const std::vector<std::size_t> bytes(static_cast<std::size_t>(ranks()), mine.size_bytes());
  ranks_->all_gather(std::as_bytes(mine), std::as_writable_bytes(std::span(all)), bytes);
  return all;
}

namespace {

// Of a block: the number of its rows and their largest |dy|, x, dy; in numbers, each part on a 256-byte boundary.
struct Layout {
  static constexpr std::size_t kAlign = 64;
  std::size_t x = kAlign, dy, end;
  Layout(std::int64_t rows, std::int32_t dims)
      : dy(x + padded(static_cast<std::size_t>(rows) * 6)),  // float64
        end(dy + padded(static_cast<std::size_t>(rows) * static_cast<std::size_t>(dims))) {}
  static std::size_t padded(std::size_t count) { return (count + kAlign - 1) / kAlign * kAlign; }
};

EncoderRows rows_in(float* block, std::int64_t rows, std::int32_t dims) {
  const Layout at(rows, dims);
  EncoderRows all;
  all.x = {reinterpret_cast<double*>(block + at.x), rows, 3, 3, Device::cuda};
  all.dy = {block + at.dy, rows, dims, dims, Device::cuda};
  all.count = reinterpret_cast<std::int32_t*>(block);
  all.largest = reinterpret_cast<std::uint32_t*>(block) + 1;
  return all;
}

}  // namespace

ShardRows::ShardRows(const Size& size) : size_(size), memory_(Layout(size.rows, size.dims).end, "rows of an encoder") {}

EncoderRows ShardRows::all() const {
  EncoderRows rows = rows_in(memory_.data(), size_.rows, size_.dims);
  if (size_.in_place) rows.count = nullptr;
  return rows;
}

void ShardRows::begin() {
  check(cudaMemsetAsync(largest(), 0, sizeof(std::uint32_t), launch().stream), "clearing a largest gradient");
}

EncoderRows ShardRows::place(std::int64_t first, std::int64_t rows) const {
  EncoderRows own = all();
  own.x = own.x.row_range(first, rows);
  own.dy = own.dy.row_range(first, rows);
  return own;
}

}  // namespace semfield::cuda
