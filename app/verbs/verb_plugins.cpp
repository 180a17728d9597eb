// plugins: lists, parameters, and laws checked in a process of their own, which a plugin may end.
#include <fmt/format.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <functional>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>

#include "app/app_context.h"
#include "app/child_process.h"
#include "app/json_output.h"
#include "app/verb.h"
#include "config/params.h"
#include "core/error.h"
#include "execution/device_library.h"
#include "plugin/loader.h"
#include "plugin/reference.h"
#include "session/assembly.h"
#include "system/process.h"

namespace semfield {
NLOHMANN_DEFINE_TYPE_NON_INTRUSIVE(LawRow, kind, name, settings, build, status, found)
}

namespace semfield::app {

namespace {

// What the process that asks the laws says to the one that started it: an object per line. "begun" and "ended" hold a
// row, "told" the code with which it ends after an error that it printed; "done" says that every law was asked.
void send(int pipe, const char* what, const nlohmann::json& value) {
  const std::string line =
      nlohmann::json{{what, value}}.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace) + "\n";
  for (std::size_t at = 0; at < line.size();) {
    const ssize_t written = write(pipe, line.data() + at, line.size() - at);
    if (written < 0 && errno != EINTR) _exit(1);  // nobody listens any more
    at += static_cast<std::size_t>(std::max<ssize_t>(written, 0));
  }
}

// What `laws` throws goes on to main(), which prints it.
void ask(int pipe, const std::function<void(LawRequest&)>& laws) {
  LawRequest request;
  request.on_begin = [&](const LawRow& row) { send(pipe, "begun", row); };
  request.on_row = [&](const LawRow& row) { send(pipe, "ended", row); };
  try {
    laws(request);
  } catch (const Error& error) {
    send(pipe, "told", static_cast<int>(error.kind()));
    throw;
  } catch (const std::exception&) {
    send(pipe, "told", static_cast<int>(ErrorKind::internal));
    throw;
  }
  send(pipe, "done", true);
}

std::string how_it_ended(int status) {
  if (WIFEXITED(status)) return fmt::format("it ended the process with exit code {}", WEXITSTATUS(status));
  return fmt::format("it ended the process by signal {} ({})", WTERMSIG(status), strsignal(WTERMSIG(status)));
}

// Calls `laws` in a process forked from this one, so before any thread is there, and `on_row` here for each row that
// it tells of. A process that ends before `laws` has returned, whatever its exit code, breaks the law under way: the
// last row says so. Returns the code that it told, 0 where it printed no error. Throws Error(unavailable) for a process
// that ends before the first law: `file` did not load.
int ask_laws_apart(const std::string& file, const std::function<void(LawRequest&)>& laws,
                   const std::function<void(const LawRow&)>& on_row) {
  std::fflush(nullptr);
  Pipe pipe = open_pipe("semfield");
  const pid_t parent = getpid(), pid = fork();
  if (pid < 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "no process can be started",
                "see what limits them: ulimit -a");
  if (pid == 0) {
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // a parent that is killed leaves no child behind
    if (getppid() != parent) _exit(128 + SIGTERM);
    pipe.read = -1;
    ask(pipe.write, laws);
    std::fflush(nullptr);
    _exit(0);
  }
  pipe.write = -1;
  std::optional<LawRow> under_way;
  int told = 0;
  bool begun = false, done = false;
  std::FILE* const lines = fdopen(dup(pipe.read), "r");
  char* line = nullptr;
  for (std::size_t room = 0; getline(&line, &room, lines) > 0;) {
    const nlohmann::json said = nlohmann::json::parse(line, nullptr, false);
    if (!said.is_object()) continue;
    if (said.contains("begun")) under_way = said["begun"].get<LawRow>();
    begun = begun || under_way;
    if (said.contains("ended")) {
      under_way.reset();
      on_row(said["ended"].get<LawRow>());
    }
    told = said.value("told", told);
    done = done || said.contains("done");
  }
  std::free(line);
  std::fclose(lines);
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) {
  }
  if (done || told != 0) return told;
  if (!begun) {
    throw Error(ErrorKind::unavailable, "plugin.module.ended",
                "cannot load plugin '" + file + "': " + how_it_ended(status),
                "fix it: a module registers its plugins, and no more");
  }
  LawRow row = under_way.value_or(LawRow{});
  row.status = LawStatus::failed;
  row.found = {how_it_ended(status) + " before the law was asked to its end"};
  on_row(row);
  return 0;
}

Json entry_json(const PluginEntry& entry) {
  Json json{
      {"kind", kind_name(entry.kind)}, {"name", entry.name}, {"summary", entry.summary}, {"module", entry.module}};
  json["parameters"] = Json::array();
  const std::unique_ptr<PluginParams> params = entry.new_params();
  for (const ParamDoc& doc : describe_params([&params](ParamVisitor& visit) { params->describe(visit); })) {
    Json parameter{{"name", doc.name},
                   {"type", doc.type},
                   {"default", doc.default_value},
                   {"range", doc.range},
                   {"help", doc.help}};
    if (!doc.choices.empty()) parameter["choices"] = doc.choices;
    json["parameters"].push_back(std::move(parameter));
  }
  return json;
}

// Every plugin, or the one of this name.
void print_plugins_json(const AppContext& context, const std::string& only = {}) {
  Json all = Json::array();
  for (const PluginEntry* entry : context.registry.entries()) {
    if (only.empty() || entry->name == only) all.push_back(entry_json(*entry));
  }
  print_json(context, {{"plugins", all}});
}

// What this build has for CUDA, into the registry's tables; no device is needed for that. Generated pages do without
// it: they are the same for every build.
void add_cuda_kernels(AppContext& context) {
  if (!has_cuda_library()) return;
  try {
    semfield::add_cuda_kernels(context.registry);
  } catch (const Error& error) {
    print_note(context, shown(error));
  }
}

// plugins check: the laws of its kind on every plugin of a file.

struct CheckOptions : Options {
  using Options::Options;
  const std::string& file = operand("file", "loadable module");
  const std::string& settings =
      value("--settings FILE",
            "parameters to check, a line each as in conformance.txt: name=value name=value, or defaults (default: the "
            "defaults alone)");
  const std::vector<std::string>& scene =
      repeated("--scene NAME=VALUE", "parameter of the file's datasets, whose laws need a scene");
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
  const int told = ask_laws_apart(
      options.file, [&](LawRequest& request) { ask_laws(options, request); },
      [&](const LawRow& row) {
        rows.push_back(row);
        if (!context.json) print_row(row);
      });
  if (told != 0) return told;
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

// plugins list: every plugin with one sentence, or with the devices that it runs on.

struct ListOptions : Options {
  using Options::Options;
  const bool& devices = flag("--devices", "print which plugin runs on which device");
};

void print_devices(AppContext& context) {
  add_cuda_kernels(context);
  if (!context.json) {
    std::fputs(support_matrix_text(context.registry).c_str(), stdout);
    return;
  }
  Json plugins = Json::array();
  for (const PluginEntry* entry : context.registry.entries())
    plugins.push_back({{"kind", kind_name(entry->kind)},
                       {"name", entry->name},
                       {"devices", devices_text(context.registry, *entry)},
                       {"module", entry->module}});
  print_json(context, {{"plugins", plugins}});
}

int run(const ListOptions& options, AppContext& context) {
  if (options.devices) {
    print_devices(context);
  } else if (context.json) {
    print_plugins_json(context);
  } else {
    std::fputs(plugins_list_text(context.registry).c_str(), stdout);
  }
  return 0;
}

// plugins show: the parameters of one plugin.

struct ShowOptions : Options {
  using Options::Options;
  const std::string& name = operand("name", "name of the plugin");
};

int run(const ShowOptions& options, AppContext& context) {
  add_cuda_kernels(context);
  const std::string text =
      plugin_details_text(context.registry, options.name);  // refuses an unknown name in either form
  if (context.json) {
    print_plugins_json(context, options.name);
  } else {
    std::fputs(text.c_str(), stdout);
  }
  return 0;
}

}  // namespace

Verb verb_plugins() { return make_group("plugins", 170, "list plugins and their parameters, and check them"); }

Verb verb_plugins_check() {
  return make_verb<CheckOptions>("plugins check", 50, "check the plugins of a file against the laws of their kinds",
                                 run);
}

Verb verb_plugins_list() {
  return make_verb<ListOptions>("plugins list", 10, "list every plugin with one sentence", run);
}

Verb verb_plugins_show() {
  return make_verb<ShowOptions>("plugins show", 20, "print the parameters of one plugin", run);
}

}  // namespace semfield::app
