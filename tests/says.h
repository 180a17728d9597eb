// What a message says, where a test asks for its meaning: the place, the values found and the remedy's words.
#pragma once

#include <initializer_list>
#include <string>
#include <string_view>

namespace semfield {

/// "" when `text` holds every one of `parts`; else the first that it does not hold, and the text.
inline std::string unsaid(std::string_view text, std::initializer_list<std::string_view> parts) {
  for (const std::string_view part : parts) {
    if (text.find(part) == std::string_view::npos)
      return "no '" + std::string(part) + "' in '" + std::string(text) + "'";
  }
  return "";
}

}  // namespace semfield
