// Shape checks of the public wrappers: one sentence that names the view, what it is and what was expected.
#pragma once

#include <cstdint>
#include <string>

#include "core/view.h"

namespace semfield::view_checks {

/// Throws Error(internal): "encoder.forward: y is [4, 3], expected [4, 6]".
[[noreturn]] void fail_shape(const char* call, const char* view, std::int64_t rows, std::int32_t cols,
                             std::int64_t want_rows, std::int32_t want_cols);
/// Throws Error(internal): "encoder.forward: <what>".
[[noreturn]] void fail(const char* call, const std::string& what);

template <class T>
void require_layout(const char* call, const char* name, const View<T>& v, Device device) {
  if (v.data == nullptr && v.rows > 0) fail(call, std::string(name) + " is empty and must not be");
  if (v.rows > 1 && v.row_stride < v.cols) fail(call, std::string(name) + " has a row stride below its columns");
  if (v.device != device) fail(call, std::string(name) + " lives on another device than the first argument");
}

/// Exactly [rows, cols], not empty (unless rows is 0), on `device`.
template <class T>
void require(const char* call, const char* name, const View<T>& v, std::int64_t rows, std::int32_t cols,
             Device device) {
  if (v.rows != rows || v.cols != cols) fail_shape(call, name, v.rows, v.cols, rows, cols);
  require_layout(call, name, v, device);
}

/// As require(), or empty: "not wanted".
template <class T>
void require_or_empty(const char* call, const char* name, const View<T>& v, std::int64_t rows, std::int32_t cols,
                      Device device) {
  if (!v.empty()) require(call, name, v, rows, cols, device);
}

/// At least `rows` rows of exactly `cols` columns.
template <class T>
void require_room(const char* call, const char* name, const View<T>& v, std::int64_t rows, std::int32_t cols,
                  Device device) {
  if (v.rows < rows || v.cols != cols) fail_shape(call, name, v.rows, v.cols, rows, cols);
  require_layout(call, name, v, device);
}

}  // namespace semfield::view_checks
