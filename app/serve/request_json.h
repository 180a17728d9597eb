// Bodies of requests as JSON, read strictly; every refusal is Error(data) with a sentence that names the key.
#pragma once

#include <array>
#include <cmath>
#include <string>
#include <string_view>
#include <vector>

#include "app/json_output.h"
#include "serve/label_loop.h"

namespace semfield::app {

[[noreturn]] void refuse_request(const std::string& message, const std::string& remedy = {});
[[noreturn]] void refuse_request_value(const std::string& key, const std::string& expected, const Json& found);

/// A map whose keys, and those of the maps in it, are known and given once.
Json parse_request(std::string_view text, const std::vector<std::string>& known);

/// What is missing leaves `into` as it is.
void read_request_flag(const Json& root, const char* key, bool& into);
void read_request_number(const Json& root, const char* key, std::int32_t low, std::int32_t high, std::int32_t& into);

/// N numbers of at most this size.
template <std::size_t N>
std::array<double, N> request_numbers(const Json& map, const char* key, double most) {
  const auto found = map.find(key);
  if (found == map.end()) refuse_request(std::string("key '") + key + "' is missing");
  const std::string expected = std::to_string(N) + " numbers";
  if (!found->is_array() || found->size() != N) refuse_request_value(key, expected, *found);
  std::array<double, N> out{};
  for (std::size_t i = 0; i < N; ++i) {
    const Json& value = (*found)[i];
    if (!value.is_number()) refuse_request_value(key, expected, value);
    out[i] = value.get<double>();
    if (!(std::abs(out[i]) <= most)) refuse_request_value(key, expected + " of a size that a scene can have", value);
  }
  return out;
}

/// {"position", "rotation", "fov_deg"}: rows of world_from_camera, degrees of the picture's width.
FreeCamera read_request_camera(const Json& map);

}  // namespace semfield::app
