// How device memory of several ranks meets: through NCCL, or through the memory of the host.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>
#include <memory>
#include <span>
#include <string>

#include "cuda/launch.h"
#include "execution/ranks/ranks.h"

namespace semfield::cuda {

/// All ranks make the same calls in the same order. What they give is the same on every rank, to the bit. An Error that
/// one rank alone meets leaves no other rank waiting.
class RankExchange {
 public:
  RankExchange() = default;
  RankExchange(const RankExchange&) = delete;
  RankExchange& operator=(const RankExchange&) = delete;
  virtual ~RankExchange() = default;

  /// Whether `sum` and `gather` only queue work on their stream, so that a graph may hold them. Else they wait for the
  /// stream and for the other ranks.
  virtual bool queues() const = 0;
  /// Memory for calls with up to `most` numbers of a rank. Throws Error(unavailable).
  virtual void reserve(std::size_t most) = 0;
  /// block = its sum over ranks, and *fault = the least of theirs; null: not wanted. Device memory.
  virtual void sum(std::span<float> block, FaultKey* fault, cudaStream_t stream) = 0;
  /// blocks [size, each]: row r of rank r becomes that of all. *fault as above.
  virtual void gather(float* blocks, std::size_t each, FaultKey* fault, cudaStream_t stream) = 0;
  /// Waits for the stream. Throws RankLost where it waits for a rank that has ended.
  virtual void wait(cudaStream_t stream) = 0;
};

/// Through the host's memory.
std::unique_ptr<RankExchange> host_exchange(Ranks& ranks);

/// To be called by all ranks, each for the device of launch(): through NCCL, where every rank has it and a device of
/// its own. Else through the host's memory, and `why_not` says why.
std::unique_ptr<RankExchange> meet_ranks(Ranks& ranks, std::string& why_not);

}  // namespace semfield::cuda
