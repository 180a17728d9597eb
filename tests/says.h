// What a message says, where a test checks its meaning: the place, the values found and the remedy's words.
#pragma once

#include <gtest/gtest.h>

#include <initializer_list>

#include "core/error.h"

namespace semfield {

inline constexpr std::size_t kShown = 4000;  ///< of a text, in a failure: pages are long

/// "" when `text` holds every one of `parts`; else the first that it does not hold, and the text.
inline std::string unsaid(std::string_view text, std::initializer_list<std::string_view> parts) {
  for (const std::string_view part : parts) {
    if (text.find(part) == std::string_view::npos)
      return "no '" + std::string(part) + "' in '" + std::string(text.substr(0, kShown)) + "'";
  }
  return "";
}

/// "" when `text` holds none of `parts`; else the first that it holds, and the text.
inline std::string unwanted(std::string_view text, std::initializer_list<std::string_view> parts) {
  for (const std::string_view part : parts) {
    if (text.find(part) != std::string_view::npos)
      return "'" + std::string(part) + "' in '" + std::string(text.substr(0, kShown)) + "'";
  }
  return "";
}

/// What the Error says that `call` throws, "" when it throws none.
template <class Call>
[[nodiscard]] std::string error_of(Call&& call) {
  try {
    call();
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}
/// The same, of an Error that is of `kind`.
template <class Call>
[[nodiscard]] std::string error_of(ErrorKind kind, Call&& call) {
  return error_of([&] {
    try {
      call();
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), kind) << error.what();
      throw;
    }
  });
}

}  // namespace semfield

#define EXPECT_HAS(text, ...) EXPECT_EQ(::semfield::unsaid(text, {__VA_ARGS__}), "")
#define EXPECT_LACKS(text, ...) EXPECT_EQ(::semfield::unwanted(text, {__VA_ARGS__}), "")
