// JSON that somebody sends or writes by hand, read strictly: every refusal names the key, what belongs there and what
// was found. `Json` is one of nlohmann's.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"
#include "core/text.h"
#include "formats/text_rows.h"

namespace semfield {

/// `error`: what a refusal throws.
template <class Json>
struct StrictJson {
  Error (*error)(const std::string& message, const std::string& remedy);

  [[noreturn]] void refuse(const std::string& message, const std::string& remedy = {}) const {
    throw error(message, remedy);
  }
  [[noreturn]] void refuse_value(const std::string& key, const std::string& expected, const Json& found) const {
    refuse("'" + key + "': expected " + expected + ", got " + shown(found));
  }

  /// What was found, short enough for a message.
  static std::string shown(const Json& value) {
    constexpr std::size_t kMost = 60;
    if (value.is_array()) return "a list of " + std::to_string(value.size());
    if (value.is_object()) return "a map";
    const std::string text = value.dump(-1, ' ', true, Json::error_handler_t::replace);
    return text.size() > kMost ? text.substr(0, kMost) + "..." : text;
  }

  /// A map in which no key stands twice, nor in those that it holds. `such`: how it begins, for the message.
  Json map(std::string_view text, const std::string& such = {}) const {
    std::string twice;
    Json root;
    try {
      root = parse_json<Json>(text, twice, [](int) {});
    } catch (const typename Json::exception& e) {
      refuse("not valid JSON: " + json_cause(e.what()));
    }
    if (!root.is_object()) refuse("expected a map" + such + ", got " + shown(root));
    if (!twice.empty()) refuse("key " + shown(Json(twice)) + " is given twice");
    return root;
  }
  /// `of`: what such a map is, for the message: " of a 'click'".
  void check_keys(const Json& map, const std::vector<std::string>& known, const std::string& of = {}) const {
    for (const auto& item : map.items())
      if (std::find(known.begin(), known.end(), item.key()) == known.end())
        refuse("unknown key " + shown(Json(item.key())) + of,
               near_name_remedy(item.key(), known, "known: " + join(known)));
  }

  /// The value of a key; a missing one is refused.
  const Json& at(const Json& map, const char* key) const {
    const auto found = map.find(key);
    if (found == map.end()) refuse(std::string("key '") + key + "' is missing");
    return *found;
  }
  /// What is missing leaves `into` as it is.
  void flag(const Json& map, const char* key, bool& into) const {
    const auto found = map.find(key);
    if (found == map.end()) return;
    if (!found->is_boolean()) refuse_value(key, "true or false", *found);
    into = found->template get<bool>();
  }
  /// A whole number between two bounds; `expected` says so.
  std::int64_t whole(const Json& value, const char* key, std::int64_t low, std::int64_t high,
                     const std::string& expected) const {
    const bool is_above =
        value.is_number_unsigned() && value.template get<std::uint64_t>() > static_cast<std::uint64_t>(high);
    if (!value.is_number_integer() || is_above) refuse_value(key, expected, value);
    const auto number = value.template get<std::int64_t>();
    if (number < low || number > high) refuse_value(key, expected, value);
    return number;
  }
};

}  // namespace semfield
