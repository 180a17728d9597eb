// plugins check: the laws of its kind on every plugin of a file.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>

#include "app/json_output.h"
#include "app/verb.h"
#include "app/verbs/plugins/laws_apart.h"
#include "core/findings.h"
#include "plugin/check/law_suite.h"
#include "plugin/linked_plugins.h"
#include "plugin/loader.h"
#include "system/shared_library.h"

namespace semfield::app {

namespace {

struct CheckOptions {
  std::string file;
  std::string settings;            ///< file of lines as in conformance.txt; "": the defaults
  std::vector<std::string> scene;  ///< NAME=VALUE of datasets
};

const char* word_of(LawStatus status) {
  if (status == LawStatus::passed) return "passed";
  return status == LawStatus::failed ? "FAILED" : "refused";
}

// What the row is about, behind kind and name.
std::string subject_of(const LawRow& row) {
  if (row.settings.empty()) return "declaration";
  return row.build.empty() ? row.settings : row.settings + ", " + row.build;
}

// The plugins of the file, in a registry of their own: the program's may have it from --plugin already.
std::vector<const PluginEntry*> load(const std::string& file, Registry& registry) {
  register_linked_plugins(registry);
  std::vector<std::pair<PluginKind, std::string>> linked;
  for (const PluginEntry* entry : registry.entries()) linked.emplace_back(entry->kind, entry->name);
  load_module(registry, file, {false, nullptr});
  std::vector<const PluginEntry*> found;
  for (const PluginEntry* entry : registry.entries()) {
    if (std::find(linked.begin(), linked.end(), std::pair(entry->kind, entry->name)) == linked.end())
      found.push_back(entry);
  }
  if (found.empty())
    throw Error(ErrorKind::data, "plugin.module.empty", file + ": registers no plugin",
                "call add_encoder, add_field, add_sampler or add_dataset");
  return found;
}

Json json_of(const LawRow& row) {
  return {{"kind", kind_name(row.kind)},   {"name", row.name},  {"settings", row.settings}, {"build", row.build},
          {"status", word_of(row.status)}, {"found", row.found}};
}

void print_row(const LawRow& row) {
  std::printf("%-8s %-16s %-40s %s\n", std::string(kind_name(row.kind)).c_str(), row.name.c_str(),
              subject_of(row).c_str(), word_of(row.status));
  for (const std::string& sentence : row.found) std::printf("    %s\n", sentence.c_str());
  std::fflush(stdout);
}

void ask_laws(const CheckOptions& options, LawRequest& request) {
  const auto suite =
      reinterpret_cast<LawSuite>(part_symbol("semfield_laws", kLawSuiteSymbol, "the laws cannot be loaded"));
  Registry registry;
  request.entries = load(options.file, registry);
  request.settings_file = options.settings;
  request.scene = options.scene;
  request.folder = std::filesystem::current_path().string();
  suite(registry, request);
}

int run(const CheckOptions& options, AppContext& context) {
  std::vector<LawRow> rows;
  ask_laws_apart(
      options.file, [&](LawRequest& request) { ask_laws(options, request); },
      [&](const LawRow& row) {
        rows.push_back(row);
        if (!context.json) print_row(row);
      });
  const auto count = [&](LawStatus status) {
    return std::count_if(rows.begin(), rows.end(), [&](const LawRow& row) { return row.status == status; });
  };
  const auto passed = count(LawStatus::passed), failed = count(LawStatus::failed), refused = count(LawStatus::refused);
  const auto first =
      std::find_if(rows.begin(), rows.end(), [](const LawRow& r) { return r.status == LawStatus::failed; });
  Diagnostics notes;
  keep_check(options.file,
             first == rows.end() ? ""
                                 : fmt::format("{} '{}', {}: {}", kind_name(first->kind), first->name,
                                               subject_of(*first), first->found.front()),
             notes);
  for (const Diagnostic& note : notes.all()) print_note(context, note.shown());
  if (context.json) {
    Json out{{"file", options.file}, {"passed", passed}, {"failed", failed}, {"refused", refused}};
    out["rows"] = Json::array();
    for (const LawRow& row : rows) out["rows"].push_back(json_of(row));
    print_json(context, out);
  } else {
    std::printf("plugins check: passed=%td failed=%td refused=%td file=%s\n", passed, failed, refused,
                options.file.c_str());
  }
  return failed == 0 ? 0 : static_cast<int>(ErrorKind::failure);
}

void words(VerbWords& verb, CheckOptions& options) {
  verb.operand("file", options.file, "loadable module");
  verb.value("--settings FILE", options.settings,
             "parameters to check, a line each as in conformance.txt: name=value name=value, or defaults (default: the "
             "defaults alone)");
  verb.repeated("--scene NAME=VALUE", options.scene, "parameter of the file's datasets, whose laws need a scene");
}

}  // namespace

Verb verb_plugins_check() {
  return with_json(make_verb<CheckOptions>("plugins check", 50,
                                           "check the plugins of a file against the laws of their kinds", words, run));
}

}  // namespace semfield::app
