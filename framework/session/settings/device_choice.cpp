#include "session/settings/device_choice.h"

#include <algorithm>
#include <optional>
#include <vector>

#include "compute/cpu_kernels.h"
#include "core/check.h"
#include "execution/device_library.h"
#include "plugin/loader.h"

namespace semfield {

namespace {

constexpr std::int64_t kRaysOnCpu = 1024, kRaysOnGpu = 8192;  // docs/decisions.md, 0036

// "field 'ball'".
std::string owner_of(const PluginSlot& slot) {
  return std::string(kind_name(slot.entry->kind)) + " '" + slot.entry->name + "'";
}

// "field 'ball'", "loss 'glow'": the first part of the run without kernels for `device`; empty: all have them.
std::string part_without_kernels(const RunConfig& config, const Registry& registry, Device device) {
  for (const PassConfig& pass : config.passes) {
    std::vector<const PluginSlot*> slots{&pass.sampler, &pass.position, &pass.direction, &pass.field};
    for (const SemanticBranchConfig& branch : pass.semantic) {
      slots.push_back(&branch.position);
      slots.push_back(&branch.field);
    }
    for (const PluginSlot* slot : slots) {
      if (slot->entry == nullptr) continue;
      std::string owner = owner_of(*slot);
      if (!registry.kernels().has(device, owner)) return owner;
    }
  }
  for (const HeadConfig& head : config.heads) {
    for (const PluginSlot* slot : {&head.head, &head.position, &head.field})
      if (std::string owner = owner_of(*slot); device != Device::cpu && !registry.kernels().has(device, owner))
        return owner;
  }
  for (const LossEntry& entry : config.losses) {
    std::string owner = "loss '" + entry.type + "'";
    if (device != Device::cpu && !registry.kernels().has(device, owner)) return owner;
  }
  return {};
}
// "field 'ball'": the first field of the run without kernels of bf16 for `device`; empty: all have them.
std::string field_without_bf16(const RunConfig& config, const Registry& registry, Device device) {
  const auto lacks = [&](const PluginSlot& slot) {
    return slot.entry != nullptr && !registry.kernels().has(device, owner_of(slot), Precision::bf16);
  };
  for (const PassConfig& pass : config.passes) {
    if (lacks(pass.field)) return owner_of(pass.field);
    for (const SemanticBranchConfig& branch : pass.semantic) {
      if (lacks(branch.field)) return owner_of(branch.field);
    }
  }
  return {};
}

bool is_automatic(const RunConfig& config) { return config.runtime.device == "auto"; }

/// That of `auto` is the first cuda device.
DeviceId asked_device(const RunConfig& config) {
  const std::optional<DeviceId> asked = device_of(is_automatic(config) ? "cuda" : config.runtime.device);
  SEMFIELD_CHECK(asked.has_value(), "runtime.device was validated");
  return *asked;
}

}  // namespace

void add_cuda_kernels(Registry& registry) {
  cuda_library().add_kernels(registry.kernels());
  add_cuda_kernels_of_modules(registry);
}

ChosenDevice chosen_device(const RunConfig& config, Registry& registry, Diagnostics& diagnostics) {
  const DeviceId asked = asked_device(config);
  if (asked.kind == Device::cpu) return {asked, "runtime.device is cpu"};
  std::string why_not;
  if (cuda_available(&why_not, asked.ordinal)) {
    add_cuda_kernels(registry);
    return device_for_parts(config, registry, diagnostics);
  }
  if (is_automatic(config)) return {DeviceId{}, why_not};
  throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
              "runtime.device: " + config.runtime.device + ": " + why_not, "set runtime.device: cpu, or auto");
}

ChosenDevice device_for_parts(const RunConfig& config, const Registry& registry, Diagnostics& diagnostics) {
  const std::string part = part_without_kernels(config, registry, Device::cuda);
  if (part.empty()) return {asked_device(config), ""};
  const std::string why_not = part + " has no cuda kernels";
  if (!is_automatic(config)) {
    throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
                "runtime.device: " + config.runtime.device + ": " + why_not,
                "set runtime.device: cpu, or auto, which stays on the CPU then");
  }
  diagnostics.warning("device.cpu.slow", "runtime.device",
                      why_not + ", so the run stays on the CPU, which is tens to hundreds of times slower than a GPU",
                      "use parts that have kernels for it: `semfield plugins list --devices` lists them");
  return {DeviceId{}, why_not};
}

Precision precision_of(const RunConfig& config, const Registry& registry, DeviceId device) {
  if (config.runtime.precision != Precision::automatic) return config.runtime.precision;
  const bool faster = device.kind != Device::cpu || bf16_is_faster();
  return faster && field_without_bf16(config, registry, device.kind).empty() ? Precision::bf16 : Precision::fp32;
}

std::vector<std::string> choose_for_device(RunConfig& config, Device device) {
  std::vector<std::string> lines;
  if (config.train.rays == 0) {
    config.train.rays = device == Device::cpu ? kRaysOnCpu : kRaysOnGpu;
    lines.push_back("train.rays: rays was set to " + std::to_string(config.train.rays) + ", which suits a " +
                    (device == Device::cpu ? "CPU" : "GPU"));
  }
  const auto choose = [&](const std::string& key, const PluginSlot& slot) {
    if (slot.entry == nullptr) return;
    std::vector<std::string> chosen;
    slot.params->choose_for(device, chosen);
    for (const std::string& sentence : chosen) lines.push_back(key + ": " + sentence);
  };
  for (const PassConfig& pass : config.passes) {
    choose(pass.key + ".sampler", pass.sampler);
    choose(pass.key + ".position", pass.position);
    choose(pass.key + ".direction", pass.direction);
    choose(pass.key + ".field", pass.field);
    for (const SemanticBranchConfig& branch : pass.semantic) {
      choose(pass.key + "." + branch.key + ".position", branch.position);
      choose(pass.key + "." + branch.key + ".field", branch.field);
    }
  }
  return lines;
}

// Steps on an H200 in fp32 and bf16 (docs/evidence/gpu.md): 22.7 and 2.24 ms with the paper's networks, 3.0 and 0.99 ms
// with a hash grid; 16.5 and 1.1 ms with the networks of configs/presets/object.yaml and 8,192 rays.
void say_slow_paths(const RunConfig& config, const Registry& registry, DeviceId device, bool bf16_instructions,
                    Diagnostics& diagnostics) {
  const bool bf16 = config.runtime.precision == Precision::bf16;
  if (device.kind == Device::cpu) {
    if (bf16 && !bf16_instructions) {
      diagnostics.warning("device.bf16.emulated", "runtime.precision",
                          "this CPU has no bf16 instructions: they are emulated, which is slower than fp32",
                          "set runtime.precision: auto");
    }
    return;
  }
  if (bf16) return;
  const std::string lacking = field_without_bf16(config, registry, device.kind);
  const std::string cost = "fp32 runs layer by layer on a GPU, 3 to 15 times slower than bf16";
  if (lacking.empty()) {
    diagnostics.warning("device.bf16.slow", "runtime.precision", cost, "set runtime.precision: auto");
  } else {
    diagnostics.warning("device.bf16.slow", "runtime.precision", cost + "; " + lacking + " has no kernels of bf16",
                        "use a field that has: `semfield plugins list --devices` lists them");
  }
}

}  // namespace semfield
