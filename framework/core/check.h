// Checks of our own promises (not of user input): they stay on in release builds.
#pragma once

#include <string>
#include <string_view>

namespace semfield {

/// Throws Error(ErrorKind::internal) with the failed expression, its place and `why`.
[[noreturn]] void check_failed(const char* expression, const char* file, int line, std::string_view why);

}  // namespace semfield

#define SEMFIELD_CHECK(condition, why)                                               \
  do {                                                                               \
    if (!(condition)) ::semfield::check_failed(#condition, __FILE__, __LINE__, why); \
  } while (false)
