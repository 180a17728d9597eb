// What every verb gets from the program. Results go to stdout, sentences to stderr.
#pragma once

#include <memory>
#include <nlohmann/json.hpp>
#include <string>

#include "config/settings/run_config.h"
#include "core/files.h"
#include "core/non_copyable.h"
#include "core/workspace.h"
#include "eval/metrics.h"
#include "execution/ranks/ranks.h"
#include "plugin/registry.h"

namespace semfield::app {

struct AppContext : NonCopyable {
  AppContext() { work.limits = &limits; }
  /// From now on verbs work with the threads and under the limits of `config`.
  void adopt(const RunConfig& config) {
    work.threads = config.runtime.threads;
    limits = config.limits;
  }

  Registry registry;
  InputLimits limits;
  LoadProgress load_progress;
  WorkSettings work;             ///< of the main thread
  std::unique_ptr<Ranks> ranks;  ///< the processes that this one leads or follows; null: it is alone
  bool quiet = false;
  bool json = false;
  std::string verb;       ///< that runs: "config check"
  std::string words;      ///< behind the program's name, for a shell
  bool terminal = false;  ///< stderr is a terminal: one progress line, overwritten
};

/// A sentence on stderr, unless the program is to be quiet.
void print_note(const AppContext& context, const std::string& text);

/// The folder of --out, with those above it; nothing for "". Throws Error(cannot_create).
void create_output_folder(const std::filesystem::path& folder);

// What --json prints: one object on stdout, whatever the verb.

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
