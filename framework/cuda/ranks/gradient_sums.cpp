#include "cuda/ranks/gradient_sums.h"

#include <fmt/format.h>

#include <algorithm>

#include "cuda/kernels/shard_sums.h"

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

void GradientSums::join() {
  if (ranks_ == nullptr || exchange_) return;
  if (ranks() > shards_) {
    throw Error(ErrorKind::config,
                fmt::format("runtime.deterministic cuts a step into {} shards, and this run has {} processes", shards_,
                            ranks()),
                fmt::format("start at most {} processes, or set runtime.deterministic: false", shards_));
  }
  std::string why_not;
  exchange_ = meet_ranks(*ranks_, why_not);
  if (!why_not.empty())
    notes_.push_back("gradients meet in the host's memory, which takes longer than NCCL: " + why_not);
}

std::size_t GradientSums::most_nodes() const {
  std::size_t most = 0;
  for (int r = 0; r < ranks(); ++r) most = std::max(most, nodes_of(own_of(r).first, own_of(r).second).size());
  return most;
}

void GradientSums::reserve() {
  if (!deterministic_) {
    std::size_t most = 0, begin = 0;
    for (const std::size_t end : ends_) {
      most = std::max(most, end - begin);
      begin = end;
    }
    if (exchange_) exchange_->reserve(most);
    return;
  }
  if (exchange_) exchange_->reserve(most_nodes() * gradients_.size());
  int level = 0;
  for (const ShardNode& node : nodes_of(own().first, own().second)) level = std::max(level, node.level);
  const std::size_t carried = static_cast<std::size_t>(level) * gradients_.size();
  if (carried_.size() != carried) carried_ = Buffer<float>(carried, "gradients of shards");
  const std::size_t nodes = exchange_ ? static_cast<std::size_t>(ranks()) * most_nodes() * gradients_.size() : 0;
  if (nodes_.size() != nodes) nodes_ = Buffer<float>(nodes, "gradients of all ranks' shards");
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
    if (!waits()) throw RankLost(error.kind(), error.message(), error.remedy());
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

float* GradientSums::gathered(int rank, std::size_t node) const {
  return nodes_.data() + (static_cast<std::size_t>(rank) * most_nodes() + node) * gradients_.size();
}

void GradientSums::shard_done(int shard) {
  if (!deterministic_) return;
  const std::vector<ShardNode> nodes = nodes_of(own().first, own().second);
  std::size_t n = 0;
  while (shard >= nodes[n].first + (1 << nodes[n].level)) ++n;
  const int number = shard - nodes[n].first, level = level_completed_by(number);
  CarriedSums below;
  below.count = level;
  const auto carried = [&](int l) { return carried_.data() + static_cast<std::size_t>(l) * gradients_.size(); };
  for (int l = 0; l < level; ++l) below.of_level[static_cast<std::size_t>(l)] = carried(l);
  const bool node_done = level == nodes[n].level;
  float* const of_node = exchange_ ? gathered(rank(), n) : gradients_.data();
  carry_gradients(gradients_, below, node_done ? of_node : carried(level));
}

void GradientSums::meet(FaultKey* fault) {
  if (!exchange_) return;
  if (!deterministic_) {
    for (std::size_t p = next_pass_; p < ends_.size(); ++p) sum_pass(p, p + 1 == ends_.size() ? fault : nullptr);
  } else {
    check(cudaEventRecord(walked_, launch().stream), "marking a step");
    check(cudaStreamWaitEvent(between_, walked_, 0), "waiting for a step");
    exchange_->gather(nodes_.data(), most_nodes() * gradients_.size(), fault, between_);
  }
  check(cudaEventRecord(summed_, between_), "marking a sum");
  check(cudaStreamWaitEvent(launch().stream, summed_, 0), "waiting for a sum");
  if (!deterministic_) return;
  TreeSums tree;
  for (int r = 0; r < ranks(); ++r) {
    const std::vector<ShardNode> nodes = nodes_of(own_of(r).first, own_of(r).second);
    for (std::size_t n = 0; n < nodes.size(); ++n) {
      const auto first = static_cast<std::size_t>(nodes[n].first);
      tree.node[first] = gathered(r, n);
      tree.level[first] = nodes[n].level;
    }
  }
  add_tree(tree, gradients_);
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
