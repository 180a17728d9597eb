// What a study asks of the program that runs it.
#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "plugin/registry.h"

namespace semfield {

struct StudyTools {
  Registry& registry;
  std::function<void(const std::string&)> note;  ///< a sentence about progress
  /// Path of a shipped file by its place in the source tree. Throws Error(no_input).
  std::function<std::string(const std::string&)> shared_file;
  /// Bytes that operator new has taken since the process began; empty: nobody counts.
  std::function<std::int64_t()> allocated_bytes = {};
};

}  // namespace semfield
