#include "core/check.h"

#include <cstring>

#include "core/error.h"

namespace semfield {

void check_failed(const char* expression, const char* file, int line, const std::string& why) {
  check_failed(expression, file, line, why.c_str());
}

void check_failed(const char* expression, const char* file, int line, const char* why) {
  const char* base = std::strrchr(file, '/');
  throw Error(ErrorKind::internal, "internal.check.failed",
              std::string(base ? base + 1 : file) + ":" + std::to_string(line) + ": " + why +
                  " (violated: " + expression + ")");
}

}  // namespace semfield
