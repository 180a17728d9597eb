// What every kernel launch of this thread shares: stream, the step's numbers in device memory, where a fault is noted;
// and device memory.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

#include "core/non_copyable.h"
#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "execution/device_library.h"
#include "model/losses/loss_list.h"
#include "model/optim/adam.h"

namespace semfield::cuda {

/// On the calling thread's device and its default stream.
DeviceCalls device_calls();

/// What changes from step to step. Kernels read it from device memory, so that a captured graph of a step stays valid.
struct StepCell {
  std::uint64_t step = 0;
  AdamStep adam;
  double semantic_normaliser = 0;
  double loss_scale[kMostLossTerms] = {};  ///< LossScales::scale
};

/// Which stage met a value that no later stage may see.
enum class Stage : std::uint8_t {
  room,  ///< more samples than there is room for: nothing behind them counts
  rays,
  samples,
  encoded_position,
  encoded_direction,
  raw_density,
  density,
  color,
  feature,
  proposal_weight,
  occupancy_density,
  logits,
  channel,
  label,
  loss,
  gradient,
};

/// A fault is a 64-bit key, stage above row; the cell keeps the smallest. No update happens once there is one.
using FaultKey = unsigned long long;
inline constexpr FaultKey kNoFault = ~FaultKey{0};
inline constexpr int kFaultRowBits = 48;

struct Launch {
  int ordinal = 0;  ///< of the device that the stream belongs to
  cudaStream_t stream = nullptr;
  const StepCell* cell = nullptr;  ///< device memory; null: RandomAddress::step counts as it is
  FaultKey* fault = nullptr;       ///< device memory, kNoFault at first
  /// Rows of the batch that are in use, in device memory (a sampler's count); null: all. Rows behind it hold finite
  /// numbers and get gradient 0, so a kernel may compute or leave them.
  const std::int32_t* live_rows = nullptr;
  bool check_at_once = false;  ///< first_fault_row waits for the device and tells; false: it says -1 at once
  bool deterministic = false;  ///< sums in a fixed order, whatever it costs
};

/// The launch of the calling thread.
const Launch& launch();
/// Sets launch().live_rows.
void set_launch_rows(const std::int32_t* live_rows);
/// Sets the launch, and the thread's current device, while it lives.
class LaunchScope : NonCopyable {
 public:
  explicit LaunchScope(const Launch& next);
  ~LaunchScope();

 private:
  Launch before_;
  int device_before_ = 0;
};

/// Throws Error for a call or launch that failed, with `what` and CUDA's own words.
void check(cudaError_t status, const char* what);
/// After a launch: throws for one that could not start.
inline void check_launch(const char* kernel) { check(cudaGetLastError(), kernel); }

/// With launch().check_at_once: waits, and gives the row of the fault of `stage` noted since the cell was reset, which
/// it resets, or -1. Else -1: whoever owns the fault cell looks later.
std::int64_t first_fault_row(Stage stage);

/// Blocks of `threads` for `count` items.
inline unsigned blocks_of(std::int64_t count, int threads) {
  return static_cast<unsigned>((count + threads - 1) / threads);
}

/// Multiprocessors of the launch's device.
int multiprocessors();

// Device memory: arenas, buffers, and what to say when there is none left.

/// Device memory, 256-byte aligned. Throws Error(unavailable): requested, free and total bytes, the buffer's name and
/// three settings that make a run smaller. During a graph capture it is an error too: a step must not allocate.
std::byte* allocate(std::size_t bytes, const char* what);
/// The same, filled with zeros; null for none.
std::byte* zeroed(std::size_t bytes, const char* what);
void release(std::byte* memory) noexcept;

/// The source of device arenas.
BlockSource arena_source();

/// Owned device array; starts as zeros.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(std::size_t count, const char* what)
      : data_(reinterpret_cast<T*>(zeroed(count * sizeof(T), what))), size_(count) {}
  T* data() const { return data_.get(); }
  std::size_t size() const { return size_; }
  View<T> view(std::int64_t rows, std::int32_t cols) const { return View<T>(data(), rows, cols, cols, Device::cuda); }

 private:
  struct Release {
    void operator()(T* memory) const { release(reinterpret_cast<std::byte*>(memory)); }
  };
  std::unique_ptr<T, Release> data_;
  std::size_t size_ = 0;
};

/// Page-locked memory of the host.
struct FreePinned {
  void operator()(void* memory) const { (void)cudaFreeHost(memory); }
};
template <class T>
using Pinned = std::unique_ptr<T[], FreePinned>;
template <class T>
Pinned<T> pinned(std::size_t count, const char* what) {
  void* memory = nullptr;
  check(cudaMallocHost(&memory, count * sizeof(T)), what);
  return Pinned<T>(static_cast<T*>(memory));
}

/// Copies in launch().stream. `upload` and `download` wait for the copy when the host memory is pageable.
template <class T>
void upload(std::span<const T> from, T* to) {
  if (from.empty()) return;
  check(cudaMemcpyAsync(to, from.data(), from.size_bytes(), cudaMemcpyHostToDevice, launch().stream),
        "copying to the device");
}
template <class T>
void download(const T* from, std::span<T> to) {
  if (to.empty()) return;
  check(cudaMemcpyAsync(to.data(), from, to.size_bytes(), cudaMemcpyDeviceToHost, launch().stream),
        "copying from the device");
}
/// Waits for the stream.
void synchronize();
/// Of the device's memory, what nobody uses.
std::size_t free_bytes();

// Which GPU a run uses.

/// "NVIDIA H200, 143.8 GB, compute capability 9.0". Throws Error(unavailable) without that device, or for one too old
/// for this build's kernels.
std::string describe_device(int ordinal);

}  // namespace semfield::cuda
