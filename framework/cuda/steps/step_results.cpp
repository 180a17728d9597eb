// What steps leave, read when they are waited for: sums of shards and ranks to losses, and faults.
#include <algorithm>
#include <cmath>

#include "cuda/stream_executor.h"

namespace semfield::cuda {

namespace {

// In order, so that the sum does not depend on which rank had the shard.
void add(LossSums& sum, const LossSums& shard) {
  sum.squares += shard.squares;
  sum.semantic += shard.semantic;
  for (std::size_t i = 0; i < kMostLossTerms; ++i) sum.terms[i] += shard.terms[i];
  sum.labelled += shard.labelled;
  sum.correct += shard.correct;
  sum.samples += shard.samples;
  sum.dense |= shard.dense;
}

}  // namespace

StepLosses StreamExecutor::losses_of(std::span<const StepSums* const> sums, const BatchScales& scales) const {
  StepLosses out;
  for (std::size_t p = 0; p < passes_.size(); ++p) {
    LossSums pass;
    for (int r = 0; r < sums_->ranks(); ++r) {
      const auto [first, last] = sums_->own_of(r);
      for (int s = first; s < last; ++s) add(pass, sums[static_cast<std::size_t>(r)]->shard[s - first][p]);
    }
    out.color += pass.squares;
    out.semantic += pass.semantic;
    out.mse = pass.squares;
    for (std::size_t i = 0; i < kMostLossTerms; ++i) out.terms[i] += pass.terms[i];
    out.samples = pass.samples;
    out.labelled = pass.labelled;
    out.correct = pass.correct;
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
    std::int64_t samples = 0;
    for (const StepSums& sums : staging_->sums(queued.size())) samples = std::max(samples, sums.shard[0][0].samples);
    if (room_.saw(samples)) {
      forget_graphs();
      forget_step();
    }
  }
  return {done_, failed, std::nullopt};
}

}  // namespace semfield::cuda
