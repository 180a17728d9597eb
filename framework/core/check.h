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

// What a part says of itself where it computes more slowly than it could.
namespace semfield {

/// A field may be one, beside Field<Real>: a run on a GPU asks its fields and warns.
class SlowPath {
 public:
  virtual ~SlowPath() = default;
  /// "runs layer by layer here; ...", what the fast way needs; "" where it is taken.
  virtual std::string slow_path() const = 0;
};

}  // namespace semfield
