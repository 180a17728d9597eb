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

/// Page-locked memory of the host; cudaFreeHost gives it back.
template <class T>
T* pinned(std::size_t count, const char* what) {
  void* memory = nullptr;
  check(cudaMallocHost(&memory, count * sizeof(T)), what);
  return static_cast<T*>(memory);
}

/// The arrays of a batch in one block, in the order of each_array.
class BatchLayout {
 public:
  BatchLayout() = default;
  /// Of batches of the shape of `like`, whose views need no data.
  explicit BatchLayout(const RayBatch& like);
  bool fits(const RayBatch& batch) const;
  std::size_t bytes() const { return bytes_; }
  /// Copies the arrays of a batch in host memory into a block.
  void write(const RayBatch& batch, std::byte* block) const;
  /// The batch in a block of device memory; its counts of tiles are host memory.
  RayBatch in(const std::byte* block) const;

 private:
  BatchShape shape_;
  std::vector<std::int64_t> label_only_;
  std::vector<std::size_t> at_;  // where the arrays that are there begin
  std::size_t bytes_ = 0;
};

/// Batches of steps on their way to the device: of each its StepCell and its rays, which may lie there already.
class Staging {
 public:
  /// For batches of the shape of `like`.
  Staging(int slots, const RayBatch& like);
  ~Staging();
  Staging(const Staging&) = delete;
  Staging& operator=(const Staging&) = delete;

  bool fits(const RayBatch& batch) const { return layout_.fits(batch); }
  /// Copies cell and batch into the slot and queues its way to the device.
  void send(int slot, const StepCell& cell, const RayBatch& batch);
  /// The same with a batch in device memory, laid out as BatchLayout says.
  void send(int slot, const StepCell& cell, const std::byte* drawn);
  /// Queues the slot's way to the device once more; drawn: as it was sent, else null.
  void send_again(int slot, const std::byte* drawn);
  /// Queues the copy of the device's sums into the slot.
  void fetch(int slot);
  /// Of the first `slots`.
  std::span<const StepSums> sums(std::size_t slots) const { return {host_sums_, slots}; }

  /// Device memory.
  const StepCell* cell() const { return reinterpret_cast<const StepCell*>(device_.data()); }
  StepSums* device_sums() const { return reinterpret_cast<StepSums*>(device_sums_.data()); }
  /// The batch on the device.
  RayBatch batch() const { return layout_.in(device_.data() + kCellBytes); }

 private:
  static constexpr std::size_t kCellBytes = 256;
  static_assert(sizeof(StepCell) <= kCellBytes);
  std::byte* slot_at(int slot) const { return host_ + static_cast<std::size_t>(slot) * (kCellBytes + layout_.bytes()); }

  BatchLayout layout_;
  std::byte* host_ = nullptr;  // [slots, kCellBytes + layout_.bytes()]
  StepSums* host_sums_ = nullptr;
  Buffer<std::byte> device_, device_sums_;
};

}  // namespace semfield::cuda
