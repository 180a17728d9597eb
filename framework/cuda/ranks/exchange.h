// How device memory of several ranks meets: through NCCL, or through the memory of the host.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "core/non_copyable.h"
#include "cuda/launch.h"
#include "execution/ranks/ranks.h"

namespace semfield::cuda {

/// All ranks make the same calls in the same order. What they give is the same on every rank, to the bit. An Error that
/// one rank alone meets leaves no other rank waiting.
class RankExchange : NonCopyable {
 public:
  virtual ~RankExchange() = default;

  /// Whether `sum` only queues work on its stream, so that a graph may hold it. Else it waits for the stream and for
  /// the other ranks.
  virtual bool queues() const = 0;
  /// Memory for calls with up to `most` numbers of a rank. Throws Error(unavailable).
  virtual void reserve(std::size_t most) = 0;
  /// block = its sum over ranks, and *fault = the least of theirs; null: not wanted. Device memory.
  virtual void sum(std::span<float> block, FaultKey* fault, cudaStream_t stream) = 0;
  /// Waits for the stream. Throws RankLost where it waits for a rank that has ended.
  virtual void wait(cudaStream_t stream) = 0;
};

/// Through the host's memory.
std::unique_ptr<RankExchange> host_exchange(Ranks& ranks);

/// To be called by all ranks, each for the device of launch(): through NCCL, where every rank has it and a device of
/// its own. Else through the host's memory, and `why_not` says why.
std::unique_ptr<RankExchange> meet_ranks(Ranks& ranks, std::string& why_not);

// Which rays of a step a rank walks.

struct RayRange {
  std::int64_t begin = 0, count = 0;
};
/// Part `number` of `parts`: ceil(rays / parts) rays; the last ones get fewer, or none.
RayRange rays_of(std::int64_t rays, int number, int parts);

// The library that exchanges by NCCL: loaded when a run has several ranks, so that others do without NCCL.

/// What it offers; its symbol is kNcclLibrarySymbol. All throw Error with NCCL's words.
struct NcclLibrary {
  std::size_t id_bytes = 0;
  /// 22809 is 2.28.9.
  int (*version)() = nullptr;
  /// What rank 0 makes for all: id_bytes bytes.
  void (*make_id)(std::byte* id) = nullptr;
  /// To be called by all ranks, each for the device of launch(). Borrows `ranks`.
  std::unique_ptr<RankExchange> (*join)(const std::byte* id, Ranks& ranks) = nullptr;
};
inline constexpr const char* kNcclLibrarySymbol = "semfield_nccl_library";

}  // namespace semfield::cuda
