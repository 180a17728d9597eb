// The seam between a run and a device beside the processor: the same parts, tensors and batches, computed elsewhere.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/workspace.h"
#include "model/pipeline.h"
#include "plugin/kernels.h"

namespace semfield {

/// Constants of Adam, and of one of its updates (optim/adam.h).
struct DeviceAdam {
  double beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8;
};
struct DeviceUpdate {
  double step_size = 0, root_scale = 1, learning_rate = 0;
};

struct DeviceOptions {
  DeviceAdam adam;
  bool trainable = true;
  bool deterministic = false;  ///< sums in a fixed order: the same bits in every run
};

/// Steps that were queued and are done.
struct DeviceSteps {
  std::vector<StepLosses> losses;      ///< of the steps that were made, in order
  std::optional<std::int64_t> failed;  ///< the step that met a value that is not finite; nothing changed in it or since
};

/// Mirrors the tensors of a host pipeline, which it borrows: the host's copy is what checkpoints hold and what a fault
/// is explained with. Throws Error with the device's own words.
class DeviceBackend {
 public:
  virtual ~DeviceBackend() = default;
  /// "NVIDIA H200, 140 GB, compute capability 9.0".
  virtual std::string description() const = 0;
  /// Values, moments and states of the host pipeline to the device; derived tensors are made there.
  virtual void upload() = 0;
  /// The same back.
  virtual void download() = 0;
  /// Queues one training step: gradients, checks, Adam, derived tensors, samplers' observe. The batch is copied before
  /// it returns. Nothing of the step may be relied on before finish(); at most most_queued() steps wait.
  virtual void queue(std::int64_t step, const RayBatch& batch, const DeviceUpdate& update) = 0;
  virtual int most_queued() const = 0;
  /// Waits for all queued steps.
  virtual DeviceSteps finish() = 0;
  /// As Pipeline::render and Pipeline::density, with host memory.
  virtual void render(const RenderJob<float>& job) = 0;
  virtual void density(View<const double> positions, View<float> sigma) = 0;
  /// Bytes held on the device.
  virtual std::size_t bytes() const = 0;
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
};

/// What the library of a device offers; its symbol is kDeviceLibrarySymbol.
struct DeviceLibrary {
  /// Adds the device's kernel tables of the linked plugins.
  void (*add_kernels)(KernelTables& tables) = nullptr;
  /// What passes are made of beside plugins.
  const Stages<float>* stages = nullptr;
  /// Throws Error(unavailable) when this machine has no such device.
  std::string (*describe)() = nullptr;
  /// `parts` were built for the device and have the tensors of `host`.
  std::unique_ptr<DeviceBackend> (*make)(Pipeline<float>& host, std::vector<PassParts<float>> parts,
                                         const DeviceOptions& options) = nullptr;
  DeviceCalls calls;
};
inline constexpr const char* kDeviceLibrarySymbol = "semfield_device_library";

/// Whether this build has CUDA kernels, be there a device or not.
bool has_cuda_library() noexcept;
/// They, loaded without asking for a device. Throws Error(unavailable) when the build has none or their library cannot
/// be loaded.
const DeviceLibrary& cuda_library();
/// The stages of a device; those of a processor in either precision. Throws as cuda_library().
template <class Real>
const Stages<Real>& stages_of(Device device) {
  if constexpr (std::is_same_v<Real, float>) {
    if (device == Device::cuda) return *cuda_library().stages;
  }
  return processor_stages<Real>();
}

/// Whether this build has CUDA kernels and this machine a device for them; `why_not` gets the reason.
bool cuda_available(std::string* why_not = nullptr);

}  // namespace semfield
