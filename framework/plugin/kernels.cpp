// Kernel tables by type, device and precision.
#include "plugin/kernels.h"

#include <algorithm>

#include "core/error.h"

namespace semfield {

namespace {
std::string variant_name(Device device, Precision precision) {
  std::string name(device_name(device));
  if (precision != Precision::fp32) name += " " + std::string(precision_name(precision));
  return name;
}
}  // namespace

std::string_view device_name(Device device) { return device == Device::cpu ? "cpu" : "cuda"; }
std::string_view precision_name(Precision precision) { return precision == Precision::fp32 ? "fp32" : "bf16"; }

bool KernelTables::has(Device device, std::string_view owner) const {
  const std::vector<std::string> variants = variants_of(owner);
  const std::string_view name = device_name(device);
  return std::any_of(variants.begin(), variants.end(),
                     [&](const std::string& variant) { return variant.substr(0, variant.find(' ')) == name; });
}

bool KernelTables::has(Device device, std::string_view owner, Precision precision) const {
  const std::vector<std::string> variants = variants_of(owner);
  return std::find(variants.begin(), variants.end(), variant_name(device, precision)) != variants.end();
}

std::string KernelTables::devices_of(std::string_view owner) const { return join(variants_of(owner)); }

std::vector<std::string> KernelTables::variants_of(std::string_view owner) const {
  std::vector<std::string> variants;
  const auto append = [&](std::string_view of, bool in_bf16) {
    const auto found = owners_.find(of);
    if (found == owners_.end()) return;
    for (const std::string& variant : found->second) {
      if (!in_bf16 && variant.ends_with(precision_name(Precision::bf16))) continue;
      if (std::find(variants.begin(), variants.end(), variant) == variants.end()) variants.push_back(variant);
    }
  };
  if (const auto block = blocks_.find(owner); block != blocks_.end()) append(block->second.name, block->second.in_bf16);
  append(owner, true);
  return variants;
}

void KernelTables::add_erased(const Key& key, std::string_view owner, const void* table) {
  const std::string variant = variant_name(key.device, key.precision);
  const auto [place, is_new] = tables_.try_emplace(key, table);
  if (!is_new && place->second != table) {
    throw Error(ErrorKind::unavailable, "plugin.kernels.twice",
                std::string(owner) + " has two " + variant + " kernel tables",
                "load only one module that brings these kernels");
  }
  std::vector<std::string>& variants = owners_[std::string(owner)];
  if (std::find(variants.begin(), variants.end(), variant) == variants.end()) variants.push_back(variant);
}

const void* KernelTables::get_erased(const Key& key, std::string_view owner) const {
  const auto found = tables_.find(key);
  const auto block = blocks_.find(owner);
  const bool refused = block != blocks_.end() && !block->second.in_bf16 && key.precision == Precision::bf16;
  if (found != tables_.end() && !refused) return found->second;
  const std::string have = devices_of(owner);
  throw Error(ErrorKind::unavailable, "plugin.kernels.missing",
              std::string(owner) + " has no " + variant_name(key.device, key.precision) +
                  " kernels in this build (has: " + (have.empty() ? "none" : have) + ")");
}

}  // namespace semfield
