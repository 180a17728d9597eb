// Numbers of JSON taken as they are: what a type would cut, or turn round, is refused.
#pragma once

#include <stdexcept>
#include <string>
#include <type_traits>

namespace semfield {

/// Numbers are counts and sizes, which are not negative. `Json` is one of nlohmann's. Throws std::out_of_range naming
/// `key` and the value, and what Json throws for another kind of value.
template <class Json, class T>
void read_json_value(const Json& map, const char* key, T& into) {
  const Json& from = map.at(key);
  bool fits = !std::is_integral_v<T> || std::is_same_v<T, bool> || from.is_number_integer();
  if (fits) {
    from.get_to(into);
    fits = Json(into) == from;
  }
  if constexpr (std::is_arithmetic_v<T> && std::is_signed_v<T>) fits = fits && into >= 0;
  if (!fits) throw std::out_of_range(std::string(key) + " is " + from.dump());
}

}  // namespace semfield
