#include "cuda/ranks/gradient_sums.h"

#include <fmt/format.h>

#include <algorithm>
#include <numeric>

#include "cuda/launch.h"

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

int GradientSums::slots_of(const DeviceOptions& options) {
  const int ranks = options.ranks == nullptr ? 1 : options.ranks->size();
  return options.trainable && options.deterministic ? ranks * most_shards_of(ranks) : 0;
}

int GradientSums::slot_of(int shard) const {
  int rank = 0;
  while (shard >= own_of(rank).second) ++rank;
  return rank * most_shards_of(ranks()) + shard - own_of(rank).first;
}

void GradientSums::join() {
  if (ranks_ == nullptr || exchange_) return;
  if (ranks() > shards_) {
    throw Error(ErrorKind::config, "ranks.shards.too_few",
                fmt::format("runtime.deterministic cuts a step into {} shards, and this run has {} processes", shards_,
                            ranks()),
                fmt::format("start at most {} processes, or set runtime.deterministic: false", shards_));
  }
  std::string why_not;
  exchange_ = meet_ranks(*ranks_, why_not);
  if (!why_not.empty())
    notes_.push_back("gradients meet in the host's memory, which takes longer than NCCL: " + why_not);
}

void GradientSums::reserve(std::vector<Gathered> gathered) {
  gathered_ = std::move(gathered);
  if (!exchange_) return;
  std::size_t most = 0, begin = 0;
  if (deterministic_) {
    for (const Gathered& one : gathered_) most = std::max(most, one.each);
  } else {
    for (const std::size_t end : ends_) {
      most = std::max(most, end - begin);
      begin = end;
    }
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
  if (!exchange_) return;
  if (!deterministic_) {
    for (std::size_t p = next_pass_; p < ends_.size(); ++p) sum_pass(p, p + 1 == ends_.size() ? fault : nullptr);
  } else {
    check(cudaEventRecord(walked_, launch().stream), "marking a step");
    check(cudaStreamWaitEvent(between_, walked_, 0), "waiting for a step");
    for (std::size_t i = 0; i < gathered_.size(); ++i)
      exchange_->gather(gathered_[i].blocks, gathered_[i].each, i + 1 == gathered_.size() ? fault : nullptr, between_);
  }
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

// `room`: what the block is laid out for.
EncoderRows rows_in(float* block, std::int64_t room, std::int64_t rows, std::int32_t dims) {
  const Layout at(room, dims);
  EncoderRows all;
  all.x = {reinterpret_cast<double*>(block + at.x), rows, 3, 3, Device::cuda};
  all.dy = {block + at.dy, rows, dims, dims, Device::cuda};
  all.count = reinterpret_cast<std::int32_t*>(block);
  all.largest = reinterpret_cast<std::uint32_t*>(block) + 1;
  return all;
}

}  // namespace

GatheredRows::GatheredRows(Size size)
    : size_(std::move(size)),
      most_(*std::max_element(size_.of_rank.begin(), size_.of_rank.end())),
      all_(std::accumulate(size_.of_rank.begin(), size_.of_rank.end(), std::int64_t{0})),
      each_(Layout(most_, size_.dims).end),
      blocks_(size_.of_rank.size() * each_, "rows of an encoder") {
  if (size_.of_rank.size() == 1) return;
  joined_ = Buffer<float>(Layout(all_, size_.dims).end, "rows of an encoder of all ranks");
}

EncoderRows GatheredRows::block(int rank) const {
  EncoderRows rows = rows_in(blocks_.data() + static_cast<std::size_t>(rank) * each_, most_,
                             size_.of_rank[static_cast<std::size_t>(rank)], size_.dims);
  if (size_.in_place) rows.count = nullptr;
  return rows;
}

void GatheredRows::begin() {
  check(cudaMemsetAsync(largest(), 0, sizeof(std::uint32_t), launch().stream), "clearing a largest gradient");
}

EncoderRows GatheredRows::place(std::int64_t first, std::int64_t rows) const {
  EncoderRows own = block(size_.rank);
  own.x = own.x.row_range(first, rows);
  own.dy = own.dy.row_range(first, rows);
  return own;
}

EncoderRows GatheredRows::joined() const {
  if (size_.of_rank.size() == 1) return block(0);
  std::vector<EncoderRows> parts;
  for (int r = 0; r < static_cast<int>(size_.of_rank.size()); ++r) parts.push_back(block(r));
  const EncoderRows all = rows_in(joined_.data(), all_, all_, size_.dims);
  check(cudaMemsetAsync(all.largest, 0, sizeof *all.largest, launch().stream), "clearing a largest gradient");
  join_rows(parts, all);
  return all;
}

}  // namespace semfield::cuda
