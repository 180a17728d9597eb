// Batches on their way to the device and a step's sums on their way back: pinned host memory in slots, so that queueing
// a step waits for nothing.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "cuda/kernels/losses.h"
#include "cuda/launch.h"
#include "cuda/memory.h"
#include "cuda/ranks/shards.h"
#include "execution/ray_batch.h"

namespace semfield::cuda {

inline constexpr int kMostPasses = 4;

/// What a step of this process leaves, of each of its shards: read back as one block.
struct StepSums {
  FaultKey fault = kNoFault;
  LossSums shard[kShards][kMostPasses];
};

/// A batch of a step in one block: StepCell, then the rays.
class Staging {
 public:
  /// For batches of the shape of `like`.
  Staging(int slots, const RayBatch& like);
  ~Staging();
  Staging(const Staging&) = delete;
  Staging& operator=(const Staging&) = delete;

  bool fits(const RayBatch& batch) const;
  /// Copies cell and batch into the slot and queues its way to the device.
  void send(int slot, const StepCell& cell, const RayBatch& batch);
  /// Queues the slot's way to the device once more.
  void send_again(int slot);
  /// Queues the copy of the device's sums into the slot.
  void fetch(int slot);
  /// Of the first `slots`.
  std::span<const StepSums> sums(std::size_t slots) const { return {host_sums_, slots}; }

  /// Device memory.
  const StepCell* cell() const { return reinterpret_cast<const StepCell*>(device_.data()); }
  StepSums* device_sums() const { return reinterpret_cast<StepSums*>(device_sums_.data()); }
  /// The batch on the device; its counts of tiles are host memory.
  RayBatch batch() const;

 private:
  BatchShape shape_;
  std::vector<std::int64_t> label_only_;
  std::vector<std::size_t> at_;  // where the arrays that are there begin, in the order of each_array
  std::size_t total_ = 0;        // bytes of cell and batch
  std::byte* host_ = nullptr;    // [slots, total_]
  StepSums* host_sums_ = nullptr;
  Buffer<std::byte> device_, device_sums_;
};

}  // namespace semfield::cuda
