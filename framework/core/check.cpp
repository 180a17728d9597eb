#include "core/check.h"

#include <cstring>

#include "core/error.h"

namespace semfield {

void check_failed(const char* expression, const char* file, int line, std::string_view why) {
  const char* base = std::strrchr(file, '/');
  throw Error(ErrorKind::internal, "internal.check.failed",
              std::string(base ? base + 1 : file) + ":" + std::to_string(line) + ": " + std::string(why) +
                  " (violated: " + expression + ")");
}

}  // namespace semfield
