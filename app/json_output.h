// What --json prints: one object on stdout, whatever the verb.
#pragma once

#include <nlohmann/json.hpp>
#include <string>

#include "app/app_context.h"
#include "eval/metrics.h"

namespace semfield::app {

using Json = nlohmann::ordered_json;

/// Bytes that are no UTF-8, as names of files may have, become the replacement character. `indent` -1: one line.
inline std::string json_text(const Json& json, int indent = -1) {
  return json.dump(indent, ' ', false, Json::error_handler_t::replace);
}

/// `results` behind the program's version as `semfield` and the verb's name as `verb`, in one line with its end. Bytes
/// that are no UTF-8, as names of folders may have, become the replacement character.
std::string json_object(const AppContext& context, const Json& results);
void print_json(const AppContext& context, const Json& results);
/// The same for --json, else `text`, lines of which the last one's end may be missing.
void print_results(const AppContext& context, const Json& results, const std::string& text);

}  // namespace semfield::app
