// Numbers in the JSON files of a run: "inf", "-inf" and "nan" as texts, null for a value without data.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>

namespace semfield {

/// Whole numbers are written as integers. `Json` is a type of nlohmann-json, which no header names.
template <class Json>
Json number_json(std::optional<double> value) {
  if (!value) return nullptr;
  if (std::isnan(*value)) return "nan";
  if (std::isinf(*value)) return *value > 0 ? "inf" : "-inf";
  if (std::abs(*value) < 1e15 && *value == std::floor(*value)) return static_cast<std::int64_t>(*value);
  return *value;
}

/// False when `json` is none of what number_json writes.
template <class Json>
bool read_number_json(const Json& json, std::optional<double>& value) {
  value.reset();
  if (json.is_null()) return true;
  if (json.is_number()) {
    value = json.template get<double>();
    return true;
  }
  if (json == "nan") value = std::numeric_limits<double>::quiet_NaN();
  if (json == "inf") value = std::numeric_limits<double>::infinity();
  if (json == "-inf") value = -std::numeric_limits<double>::infinity();
  return value.has_value();
}

}  // namespace semfield
