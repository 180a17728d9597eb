// The library of a device beside the CPU, loaded when a run asks for it.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "core/workspace.h"
#include "execution/pipeline.h"
#include "execution/ranks/ranks.h"
#include "model/param_store.h"
#include "plugin/grouping.h"
#include "plugin/kernels.h"
#include "plugin/mlp/mlp.h"

namespace semfield {

struct DeviceOptions {
  int ordinal = 0;
  bool trainable = true;
  bool deterministic = false;  ///< sums in a fixed order: the same bits in every run; for one rank
  const KernelTables* kernels = nullptr;  ///< where losses find theirs; null only without losses
  Ranks* ranks = nullptr;  ///< processes that make every step together, each with a device; null: this one alone
};

/// Single calls of components on a device, and memory for them: what tests of plugins need (testkit/host_twin.h).
struct DeviceCalls {
  BlockSource memory;
  /// Both wait for the device.
  void (*to_device)(const void* from, std::byte* to, std::size_t bytes) = nullptr;
  void (*to_host)(const std::byte* from, void* to, std::size_t bytes) = nullptr;
  /// Calls `body`, whose kernels look for faults at once, and waits. Throws Error(failure) for a fault that `body` left
  /// behind. `deterministic` as in DeviceOptions.
  void (*run)(bool deterministic, const std::function<void()>& body) = nullptr;
  /// Calls `body`, whose memory and copies are those of this device of the machine.
  void (*on)(int ordinal, const std::function<void()>& body) = nullptr;
};

/// Steps of learning a grouping from points of images. Views are host memory. The sum of a step is divided by its
/// points, images * per_image.
struct GroupingLessons {
  const Mlp<float>& network;  ///< built for the device
  const Grouping& grouping;
  GroupingKernel kernel;     ///< of the device
  ParamStore<float>& store;  ///< of the network and of its slow copy, each with the network's tensors alone
  ParamStore<float>& slow;
  int ordinal = 0;
  View<const float> points = {};  ///< [N, inputs] of the network
  std::span<const AdamStep> updates = {};
  std::int64_t images = 0, per_image = 0;  ///< of a step
  /// Gives the points [per_image] of a step's image, and their segments; returns how many the image has. Called from
  /// several threads.
  std::function<std::int32_t(std::int64_t step, std::int64_t image, std::span<std::int32_t> point,
                             std::span<std::int32_t> segment)>
      draw = {};
  std::function<void(double done, double of)> progress = {};  ///< may be null
};

/// What the library of a device offers; its symbol is kDeviceLibrarySymbol.
struct DeviceLibrary {
  /// Adds the device's kernel tables of the linked plugins.
  void (*add_kernels)(KernelTables& tables) = nullptr;
  /// What passes are made of beside plugins.
  const Stages<float>* stages = nullptr;
  /// "NVIDIA H200, 140 GB, compute capability 9.0". Throws Error(unavailable) when this machine has no such device.
  std::string (*describe)(int ordinal) = nullptr;
  /// `parts` were built for the device and have the tensors of `host`, which the executor borrows.
  std::unique_ptr<Executor<float>> (*make)(Pipeline<float>& host, std::vector<PassParts<float>> parts,
                                           const DeviceOptions& options) = nullptr;
  DeviceCalls calls;
  /// Stores have what was learned afterwards. The same bits each time.
  void (*learn_grouping)(const GroupingLessons& lessons) = nullptr;
};
inline constexpr const char* kDeviceLibrarySymbol = "semfield_device_library";

/// Whether this build has CUDA kernels, be there a device or not.
bool has_cuda_library() noexcept;
/// They, loaded without asking for a device. Throws Error(unavailable) when the build has none or their library cannot
/// be loaded.
const DeviceLibrary& cuda_library();
/// The stages of a device; those of a CPU in either precision. Throws as cuda_library().
template <class Real>
const Stages<Real>& stages_of(Device device) {
  if constexpr (std::is_same_v<Real, float>) {
    if (device == Device::cuda) return *cuda_library().stages;
  }
  return cpu_stages<Real>();
}

/// Whether this build has CUDA kernels and this machine that device for them; `why_not` gets the reason.
bool cuda_available(std::string* why_not = nullptr, int ordinal = 0);

}  // namespace semfield
