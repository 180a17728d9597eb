// A device of this machine, and how settings name it.
#pragma once

#include <optional>
#include <string_view>

#include "core/view.h"

namespace semfield {

struct DeviceId {
  Device kind = Device::cpu;
  int ordinal = 0;  ///< 0 on the CPU
  bool operator==(const DeviceId&) const = default;
};

/// "cpu", "cuda" (the first one) or "cuda:1"; anything else is no device.
inline std::optional<DeviceId> device_of(std::string_view text) {
  if (text == "cpu") return DeviceId{};
  constexpr std::string_view kCuda = "cuda";
  if (!text.starts_with(kCuda)) return std::nullopt;
  DeviceId id{Device::cuda, 0};
  if (text == kCuda) return id;
  const std::string_view digits = text.substr(kCuda.size() + 1);
  if (text[kCuda.size()] != ':' || digits.empty() || digits.size() > 3) return std::nullopt;
  for (const char digit : digits) {
    if (digit < '0' || digit > '9') return std::nullopt;
    id.ordinal = 10 * id.ordinal + (digit - '0');
  }
  return id;
}

}  // namespace semfield
