// Where a run computes and in which precision: what its settings ask for, held against what build and machine have.
#pragma once

#include <string>
#include <vector>

#include "core/device_id.h"
#include "core/error.h"
#include "plugin/registry.h"
#include "session/settings/run_config.h"

namespace semfield {

struct ChosenDevice {
  DeviceId device;
  std::string no_cuda;  ///< why it is the CPU
};
/// The device that the run's configuration asks for; its kernels are then in the registry's tables. `auto` is the first
/// cuda device where build and machine have it and every part of the passes and term of the loss has kernels for it;
/// one without them is noted and leaves the run on the CPU. Throws Error(unavailable) with the reason when a cuda
/// device is asked for and cannot be had.
ChosenDevice chosen_device(const RunConfig& config, Registry& registry, Diagnostics& diagnostics);
/// runtime.precision, or what `auto` is there: bf16 where the device computes it faster and every field has kernels.
Precision precision_of(const RunConfig& config, const Registry& registry, DeviceId device);
/// Sizes that the configuration leaves to the device become numbers: rays of a step, and what plugins of passes leave
/// to it. "train.rays: sentence" each.
std::vector<std::string> choose_for_device(RunConfig& config, Device device);
/// CUDA kernels of linked plugins and loaded modules into the registry's tables; a device is not needed. Throws
/// Error(unavailable) when the build has none.
void add_cuda_kernels(Registry& registry);
/// As chosen_device where a device is there and its tables are in the registry.
ChosenDevice device_for_parts(const RunConfig& config, const Registry& registry, Diagnostics& diagnostics);

/// A finding for each way in which `device` trains more slowly than it could: what it costs, and the setting that has
/// the fast way. runtime.precision must be settled; `bf16_instructions`: the CPU computes bf16 by instructions of its
/// own (bf16_is_native).
void say_slow_paths(const RunConfig& config, const Registry& registry, DeviceId device, bool bf16_instructions,
                    Diagnostics& diagnostics);

}  // namespace semfield
