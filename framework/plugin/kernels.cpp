// Kernel tables by type and device.
#include "plugin/kernels.h"

#include "core/error.h"

namespace semfield {

std::string_view device_name(Device device) { return device == Device::cpu ? "cpu" : "cuda"; }

std::string KernelTables::devices_of(std::string_view owner) const {
  const auto found = owners_.find(owner);
  std::string text;
  if (found == owners_.end()) return text;
  for (const Device device : found->second) {
    if (!text.empty()) text += ", ";
    text += device_name(device);
  }
  return text;
}

void KernelTables::add_erased(std::type_index type, Device device, std::string_view owner, const void* table) {
  const auto [place, is_new] = tables_.try_emplace({type, device}, table);
  if (!is_new && place->second != table) {
    throw Error(ErrorKind::unavailable,
                std::string(owner) + " has two " + std::string(device_name(device)) + " kernel tables",
                "load only one module that brings these kernels");
  }
  std::vector<Device>& devices = owners_[std::string(owner)];
  for (const Device known : devices) {
    if (known == device) return;
  }
  devices.push_back(device);
}

const void* KernelTables::get_erased(std::type_index type, Device device, std::string_view owner) const {
  const auto found = tables_.find({type, device});
  if (found != tables_.end()) return found->second;
  const std::string have = devices_of(owner);
  throw Error(ErrorKind::unavailable, std::string(owner) + " has no " + std::string(device_name(device)) +
                                          " kernels in this build (has: " + (have.empty() ? "none" : have) + ")");
}

}  // namespace semfield
