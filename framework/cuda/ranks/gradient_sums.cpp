#include "cuda/ranks/gradient_sums.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield::cuda {

GradientSums::GradientSums(const DeviceOptions& options, std::span<float> gradients, std::vector<std::size_t> ends)
    : ranks_(options.trainable ? options.ranks : nullptr),
      deterministic_(options.deterministic),
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
  if (!exchange_) return;
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
  overlapped_ = overlapped && exchange_ && exchange_->queues();
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

}  // namespace semfield::cuda
