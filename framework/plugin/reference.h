// What plugins there are and what they take, as text and Markdown, from their own declarations.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/view.h"
#include "plugin/registry.h"

namespace semfield {

/// One plugin a line, grouped by kind: name, sentence, module.
std::string plugins_list_text(const Registry& registry);
/// Every plugin of that name (kinds may share one), with its parameters: type, default, range, sentence. Throws
/// Error(config) for an unknown name, with the nearest known.
std::string plugin_details_text(const Registry& registry, const std::string& name);
/// "cpu, cuda": where one entry runs in this build.
std::string devices_text(const Registry& registry, const PluginEntry& entry);
/// Plugins by device: which kernels this build has. Datasets run on the host and have none.
std::string support_matrix_text(const Registry& registry);

/// Markdown table of parameters, or a sentence when there are none. Ends with a line feed.
std::string parameter_table_markdown(const std::vector<ParamDoc>& params);
std::string parameter_table_markdown(const PluginEntry& entry);
/// The page of all plugins (docs/reference/plugins.md of the built documents).
std::string plugins_markdown(const Registry& registry);

}  // namespace semfield

// Shape checks of the public wrappers: one sentence that names the view, what it is and what was expected.
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
