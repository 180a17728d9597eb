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

}  // namespace semfield::cuda
