// The exit codes of the program, in words.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace semfield::app {

/// By ascending code; "130, 143" for one meaning of two.
inline const std::vector<std::pair<std::string, std::string>>& exit_codes() {
  static const std::vector<std::pair<std::string, std::string>> codes{
      {"0", "done"},
      {"1", "failure, such as a gradient that is not finite"},
      {"2", "wrong usage"},
      {"65", "the data are wrong"},
      {"66", "an input is missing"},
      {"69", "a plugin, device or package is not available"},
      {"70", "internal error"},
      {"73", "an output cannot be created"},
      {"74", "reading or writing failed"},
      {"78", "the configuration is wrong"},
      {"130, 143", "stopped by SIGINT or SIGTERM, after an orderly checkpoint"}};
  return codes;
}

}  // namespace semfield::app
