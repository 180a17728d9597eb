// How a step is shared: which rays of its batch a rank walks, and how gradients on devices meet again: by NCCL, or in
// the memory of the host.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "core/error.h"
#include "core/non_copyable.h"
#include "cuda/launch.h"
#include "execution/device_library.h"
#include "execution/ranks/ranks.h"

namespace semfield::cuda {

struct StepSums;

// NCCL is loaded when a run has several ranks, so that others do without it.

/// What the library of NCCL offers; its symbol is kNcclLibrarySymbol. All throw Error with NCCL's words.
struct NcclLibrary {
  std::size_t id_bytes = 0;
  /// 22809 is 2.28.9.
  int (*version)() = nullptr;
  /// What rank 0 makes for all: id_bytes bytes.
  void (*make_id)(std::byte* id) = nullptr;
  /// To be called by all ranks, each for the device of launch(): a communicator.
  void* (*join)(const std::byte* id, int rank, int ranks) = nullptr;
  /// Gives up what still waits for a rank that has ended.
  void (*leave)(void* communicator) = nullptr;
  /// Queues on the stream: block = its sum over ranks, and *fault = the least of theirs; null: not wanted.
  void (*sum)(void* communicator, std::span<float> block, FaultKey* fault, cudaStream_t stream) = nullptr;
  /// Throws where a sum failed behind the callers' backs.
  void (*check)(void* communicator) = nullptr;
};
inline constexpr const char* kNcclLibrarySymbol = "semfield_nccl_library";

// Which rays of a step a rank walks.

struct RayRange {
  std::int64_t begin = 0, count = 0;
};
/// Part `number` of `parts`: ceil(rays / parts) rays; the last ones get fewer, or none.
RayRange rays_of(std::int64_t rays, int number, int parts);

// How the gradients of a step meet.

/// A rank has its part of the batch, and gradients are summed pass by pass, each while the next pass is walked. All
/// ranks make the same calls in the same order; sums are the same on every rank, to the bit, and an Error that one rank
/// alone meets leaves no other waiting. Without ranks nothing is exchanged; launches are those of launch().
class GradientSums : NonCopyable {
 public:
  /// Borrows `gradients`, in device memory, those of pass p behind those of the pass before, from ends[p - 1] to
  /// ends[p].
  GradientSums(const DeviceOptions& options, std::span<float> gradients, std::vector<std::size_t> ends);
  ~GradientSums();

  int rank() const { return ranks_ == nullptr ? 0 : ranks_->rank(); }
  int ranks() const { return ranks_ == nullptr ? 1 : ranks_->size(); }
  /// This rank's rays of a batch.
  RayRange own(std::int64_t rays) const { return rays_of(rays, rank(), ranks()); }

  /// To be called by all ranks, before a step; meets the others once: by NCCL, where every rank has it and a device of
  /// its own, or else in the host's memory. Throws Error where ranks cannot work like this.
  void join();
  /// What `join` has to tell, once: why gradients do not meet by NCCL.
  std::vector<std::string> take_notes() { return std::exchange(notes_, {}); }
  /// Memory for what meets. Throws Error(unavailable).
  void reserve();
  /// Calls `work`, which may fail on one rank: then all throw.
  void agree(const std::function<void()>& work);
  /// Calls `work` when the other ranks rely on this one's step. With several ranks its error is thrown by the next
  /// `agree`, and so on all of them; but where their devices may wait for this one's for ever, it is RankLost: when
  /// this process ends, they notice.
  void afterwards(const std::function<void()>& work);
  /// Whether `meet` waits for the other ranks, so that no graph may hold it.
  bool waits() const { return joined_ && !communicator_; }

  /// Before the walk of a step. overlapped: passes are summed when they are done, else all by `meet`.
  void begin(bool overlapped);
  /// The gradients of pass p are complete, on launch().stream.
  void pass_done(std::size_t pass);
  /// The gradients become those of the batch, and *fault the least of all, for what launch().stream does next.
  void meet(FaultKey* fault);
  /// Waits for launch().stream. Throws RankLost where a device fails or waits for a rank that has ended.
  void wait();

  /// [ranks, mine.size()]
  std::vector<StepSums> of_all_ranks(std::span<const StepSums> mine) const;

 private:
  void join_nccl();
  void sum_pass(std::size_t pass, FaultKey* fault);
  void sum_on_host(std::span<float> block, FaultKey* fault);

  Ranks* ranks_;
  bool deterministic_;
  std::vector<std::string> notes_;
  std::span<float> gradients_;
  std::vector<std::size_t> ends_;
  bool joined_ = false;
  const NcclLibrary* nccl_ = nullptr;
  void* communicator_ = nullptr;  // null: sums are made on the host
  Pinned<float> own_, all_;       // of the host's sums
  FaultKey least_ = kNoFault;
  std::optional<Error> pending_;
  cudaStream_t between_ = nullptr;  // the sums of passes
  cudaEvent_t walked_ = nullptr, summed_ = nullptr;
  bool overlapped_ = false;
  std::size_t next_pass_ = 0;  // that is to be summed
};

}  // namespace semfield::cuda
