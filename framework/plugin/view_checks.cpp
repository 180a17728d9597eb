// The sentences of failed shape checks.
#include "plugin/view_checks.h"

#include "core/error.h"

namespace semfield::view_checks {

namespace {
std::string shape(std::int64_t rows, std::int32_t cols) {
  std::string text = "[";
  text += std::to_string(rows);
  text += ", ";
  text += std::to_string(cols);
  text += "]";
  return text;
}
}  // namespace

void fail_shape(const char* call, const char* view, std::int64_t rows, std::int32_t cols, std::int64_t want_rows,
                std::int32_t want_cols) {
  fail(call, std::string(view) + " is " + shape(rows, cols) + ", expected " + shape(want_rows, want_cols));
}

void fail(const char* call, const std::string& what) {
  throw Error(ErrorKind::internal, "internal.view.shape", std::string(call) + ": " + what);
}

}  // namespace semfield::view_checks
