// Batches on their way to the device and a step's sums on their way back: pinned host memory in slots, so that queueing
// a step waits for nothing.
#pragma once

#include <cstdint>
#include <span>

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

/// Rays [begin, begin + count) of a batch, with the share of the whole.
RayBatch rows_of(const RayBatch& batch, std::int64_t begin, std::int64_t count);

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
  /// The batch on the device.
  RayBatch batch() const;

 private:
  struct Layout {
    std::size_t origin = 0, direction = 0, near_far = 0, target = 0, label = 0, soft = 0, depth = 0, total = 0;
  };
  std::int64_t rays_;
  bool has_labels_, has_depth_;
  std::int32_t soft_classes_;
  double label_only_share_;
  Layout at_;
  std::byte* host_ = nullptr;  // [slots, at_.total]
  StepSums* host_sums_ = nullptr;
  Buffer<std::byte> device_, device_sums_;
};

}  // namespace semfield::cuda
