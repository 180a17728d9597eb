// What the program says of itself: its words, keys and plugins, and how well they hold and how fast they are.
#include <fmt/format.h>
#include <sys/mman.h>
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
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <string>

#include "app/app_context.h"
#include "app/bench/bench.h"
#include "app/verb.h"
#include "config/config_words.h"
#include "config/explain.h"
#include "config/params.h"
#include "config/settings/choices.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"
#include "execution/device_library.h"
#include "plugin/loader.h"
#include "plugin/reference.h"
#include "train/assembly.h"

namespace semfield::app {

// plugins: lists, parameters, and laws checked in a process of their own, which a plugin may end.

namespace {

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
Json plugins_json(const Registry& registry, const std::string& only = {}) {
  Json all = Json::array();
  for (const PluginEntry* entry : registry.entries()) {
    if (only.empty() || entry->name == only) all.push_back(entry_json(*entry));
  }
  return {{"plugins", all}};
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

// The plugins of the file, in a registry of their own: the program's may have it from --plugin already.
std::vector<const PluginEntry*> load(const std::string& file, Registry& registry) {
  register_linked_plugins(registry);
  std::vector<std::pair<PluginKind, std::string>> linked;
  for (const PluginEntry* entry : registry.entries()) linked.emplace_back(entry->kind, entry->name);
  load_module(registry, file);
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

void print_row(const Json& row) {
  const auto text = [&](const char* key) { return row[key].get<std::string>(); };
  std::string subject = text("settings").empty() ? "declaration" : text("settings");
  if (!text("build").empty()) subject += ", " + text("build");
  fmt::print("{:<8} {:<16} {:<40} {}\n", text("kind"), text("name"), subject, text("status"));
  for (const Json& sentence : row["found"]) fmt::print("    {}\n", sentence.get<std::string>());
  std::fflush(stdout);
}

// What the process that asks the laws leaves to the one that started it, however it ends: `rows`, the last of which is
// being asked where it is `open`; which `law` of it; `told`: it ended by an error, which it prints; `done`: every law
// was asked.
void leave(int memory, const Json& asked) {
  const std::string text = json_text(asked);
  const bool left = pwrite(memory, text.data(), text.size(), 0) == std::ssize(text) &&
                    ftruncate(memory, static_cast<off_t>(text.size())) == 0;
  if (!left) throw write_error("write", "a file in memory", errno);
}

// Leaves what it is about before each law. What the laws throw goes on to main(), which prints it.
void ask_laws(const CheckOptions& options, bool silent, int memory) {
  Json asked{{"rows", Json::array()}};
  const auto suite =
      reinterpret_cast<LawSuite>(part_symbol("semfield_laws", kLawSuiteSymbol, "the laws cannot be loaded"));
  Registry registry;
  LawRequest request;
  // An open row is replaced when its build is known and when it has ended.
  const auto keep = [&](const LawRow& row, bool open) {
    if (asked.value("open", false)) asked["rows"].erase(asked["rows"].size() - 1);
    asked["rows"].push_back(json_of(row));
    asked["open"] = open;
    asked["law"] = "";
  };
  request.on_begin = [&](const LawRow& row) {
    keep(row, true);
    leave(memory, asked);
  };
  request.on_law = [&](const std::string& law) {
    asked["law"] = law;
    leave(memory, asked);
  };
  request.on_row = [&](const LawRow& row) {
    keep(row, false);
    if (!silent) print_row(asked["rows"].back());
    leave(memory, asked);
  };
  try {
    request.entries = load(options.file, registry);
    request.settings_file = options.settings;
    request.scene = options.scene;
    request.folder = std::filesystem::current_path().string();
    suite(registry, request);
  } catch (...) {
    asked["told"] = true;
    leave(memory, asked);
    throw;
  }
  asked["done"] = true;
  leave(memory, asked);
}

std::string how_it_ended(int status) {
  if (WIFEXITED(status)) return fmt::format("it ended the process with exit code {}", WEXITSTATUS(status));
  return fmt::format("it ended the process by signal {} ({})", WTERMSIG(status), strsignal(WTERMSIG(status)));
}

// A process that ends before every law was asked, whatever its exit code, breaks the law under way.
int run(const CheckOptions& options, AppContext& context) {
  const FileDescriptor memory(memfd_create("laws", MFD_CLOEXEC));
  leave(memory, {{"rows", Json::array()}});
  std::fflush(nullptr);
  const pid_t parent = getpid(), pid = fork();  // before any thread is there
  if (pid < 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "no process can be started",
                "see what limits them: ulimit -a");
  if (pid == 0) {
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // a parent that is killed leaves no child behind
    if (getppid() != parent) _exit(128 + SIGTERM);
    ask_laws(options, context.json, memory);
    std::fflush(nullptr);
    _exit(0);
  }
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) {
  }
  Json asked = Json::parse(read_text_file(fmt::format("/proc/self/fd/{}", static_cast<int>(memory))));
  Json& rows = asked["rows"];
  if (asked.contains("told")) return WIFEXITED(status) ? WEXITSTATUS(status) : static_cast<int>(ErrorKind::internal);
  if (!asked.contains("done")) {
    if (rows.empty())
      throw Error(ErrorKind::unavailable, "plugin.module.ended",
                  "cannot load plugin '" + options.file + "': " + how_it_ended(status),
                  "fix it: a module registers its plugins, and no more");
    const std::string law = asked.value("law", "");
    if (!asked.value("open", false)) rows.push_back(json_of({}));
    rows.back()["status"] = word_of(LawStatus::failed);
    rows.back()["found"] = Json::array(
        {how_it_ended(status) + (law.empty() ? " before the law was asked to its end" : " in the law '" + law + "'")});
    if (!context.json) print_row(rows.back());
  }
  const auto count = [&](LawStatus wanted) {
    return std::count_if(rows.begin(), rows.end(), [&](const Json& row) { return row["status"] == word_of(wanted); });
  };
  const auto passed = count(LawStatus::passed), failed = count(LawStatus::failed), refused = count(LawStatus::refused);
  print_results(
      context, {{"file", options.file}, {"passed", passed}, {"failed", failed}, {"refused", refused}, {"rows", rows}},
      fmt::format("plugins check: passed={} failed={} refused={} file={}", passed, failed, refused, options.file));
  return failed == 0 ? 0 : static_cast<int>(ErrorKind::failure);
}

// plugins list: every plugin with one sentence, or with the devices that it runs on.

struct ListOptions : Options {
  using Options::Options;
  const bool& devices = flag("--devices", "print which plugin runs on which device");
};

Json devices_json(const Registry& registry) {
  Json plugins = Json::array();
  for (const PluginEntry* entry : registry.entries())
    plugins.push_back({{"kind", kind_name(entry->kind)},
                       {"name", entry->name},
                       {"devices", devices_text(registry, *entry)},
                       {"module", entry->module}});
  return {{"plugins", plugins}};
}

int run(const ListOptions& options, AppContext& context) {
  if (options.devices) {
    add_cuda_kernels(context);
    print_results(context, devices_json(context.registry), support_matrix_text(context.registry));
  } else {
    print_results(context, plugins_json(context.registry), plugins_list_text(context.registry));
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
  const std::string text = plugin_details_text(context.registry, options.name);  // refuses an unknown name
  print_results(context, plugins_json(context.registry, options.name), text);
  return 0;
}

}  // namespace

Verb verb_plugins() { return make_group("plugins", 170, "list plugins and their parameters, and check them"); }

Verb verb_plugins_check() {
  return make_verb<CheckOptions>("plugins check", 50, "check the plugins of a file against the laws of their kinds",
                                 {"build/my_plugin.so", "build/my_plugin.so --settings conformance.txt"}, run);
}

Verb verb_plugins_list() {
  return make_verb<ListOptions>("plugins list", 10, "list every plugin with one sentence", {"", "--devices"}, run);
}

Verb verb_plugins_show() {
  return make_verb<ShowOptions>("plugins show", 20, "print the parameters of one plugin",
                                {"hash_grid", "occupancy_grid --json"}, run);
}

// config: a configuration read as a run would, explained and compared.

namespace {

// config check: every error reported.

struct ConfigWords : Options {
  using Options::Options;
  const std::string& config = operand("config", "configuration file (YAML)");
  const std::vector<std::string>& set = settings();
};

int check(const ConfigWords& options, AppContext& context) {
  load_run_config(options.config, options.set, context.registry);
  print_results(context, {{"config", options.config}, {"errors", 0}}, options.config + ": no errors");
  return 0;
}

// config diff: what differs between two configurations.

struct DiffOptions : Options {
  using Options::Options;
  const std::string& a = operand("config_a", "configuration file (YAML), such as a run.yaml");
  const std::string& b = operand("config_b", "the other one");
};

int run(const DiffOptions& options, AppContext& context) {
  const RunConfig first = load_run_config(options.a, {}, context.registry);
  const RunConfig second = load_run_config(options.b, {}, context.registry);
  const std::vector<ConfigDifference> found = config_differences(resolved_config(first), resolved_config(second));
  Json differences = Json::array();
  std::string lines;
  for (const ConfigDifference& d : found) {
    const bool other = is_part_of_identity(d.key);
    differences.push_back({{"key", d.key}, {"a", d.left}, {"b", d.right}, {"other_training", other}});
    lines += d.text() + (other ? "\n" : "   # the same training\n");
  }
  print_results(context, {{"differences", differences}}, lines);
  return 0;
}

// config explain: the final tree, with where each value comes from.

// What stands as `auto` is settled when a session opens; each such setting's sentence, as comments below the tree.
std::string open_choices(const ConfigNode& tree) {
  std::string out;
  const std::vector<ConfigSetting> settings = config_settings(tree);
  for (const SectionDoc& section : describe_sections()) {
    for (const ParamDoc& param : section.params) {
      const std::string key = section.path + "." + param.name;
      const bool open = std::any_of(settings.begin(), settings.end(),
                                    [&](const ConfigSetting& s) { return s.key == key && s.value == "auto"; });
      if (open) out += "# " + key + " is auto: " + param.help + "\n";
    }
  }
  return out;
}

int explain(const ConfigWords& options, AppContext& context) {
  const ConfigNode written = compose_config(options.config, options.set);
  const RunConfig config = load_run_config(options.config, options.set, context.registry);
  const ConfigNode tree = with_origins(resolved_config(config), written);
  Json settings = Json::array();
  for (const ConfigSetting& setting : config_settings(tree))
    settings.push_back({{"key", setting.key}, {"value", setting.value}, {"from", setting.from}});
  print_results(context, {{"settings", settings}}, explain_config(tree) + open_choices(tree));
  return 0;
}

}  // namespace

Verb verb_config() { return make_group("config", 150, "check, explain and compare configurations"); }

Verb verb_config_check() {
  return make_verb<ConfigWords>("config check", 10, "read a configuration and report every error",
                                {"configs/my_photos.yaml", "configs/my_photos.yaml --set train.rays=2048"}, check);
}

Verb verb_config_diff() {
  return make_verb<DiffOptions>(
      "config diff", 30, "print what differs between two configurations",
      {"configs/my_photos.yaml runs/my_photos/run.yaml", "runs/my_photos/run.yaml runs/my_clicks/run.yaml"}, run);
}

Verb verb_config_explain() {
  return make_verb<ConfigWords>("config explain", 20, "print the final tree, with the origin of every value",
                                {"configs/my_photos.yaml", "configs/my_photos.yaml --json"}, explain);
}

// help: the words of the program, of a group or of a verb, on the terminal, as pages, and in shells.

namespace {

struct HelpOptions : Options {
  explicit HelpOptions(const Declaration& at) : Options(at) {
    excludes("--pages", "VERB");
    excludes("--completion", "VERB");
    excludes("--completion", "--pages");
  }
  const std::vector<std::string>& verb =
      operands("[verb]", "verb, such as: train, config check (default: the list of all verbs)", words_of_verbs());
  const std::string& pages =
      value("--pages FOLDER",
            "copy of the pages of the source tree, in which those about verbs, plugins and keys are written");
  const bool& completion = flag("--completion", "print a script by which bash and zsh complete verbs and options");
};

// Tables of every section of a configuration, under headings of their own.
std::string section_tables() {
  std::string text;
  for (const SectionDoc& section : describe_sections())
    text +=
        "### `" + section.path + "`: " + section.sentence + "\n\n" + parameter_table_markdown(section.params) + "\n";
  return text;
}

// Pages of the program's own words: verbs and plugins whole, and tables where a page has their mark.
void write_pages(const fs::path& root, const AppContext& context) {
  if (!fs::is_directory(root / "plugins"))
    throw Error(ErrorKind::no_input, "files.folder.missing", "--pages " + root.string() + ": it has no folder plugins",
                "name a copy of the pages of the source tree");
  const fs::path reference = root / "docs" / "reference";
  fs::create_directories(reference);
  write_file_atomic((reference / "plugins.md").string(), plugins_markdown(context.registry));
  write_file_atomic((reference / "verbs.md").string(), verbs_page());
  int filled = 0;
  const auto fill = [&filled](const fs::path& path, const std::string& mark, const std::string& part) {
    std::string text = fs::exists(path) ? read_text_file(path.string()) : "";
    const std::size_t at = text.find(mark);
    if (at == std::string::npos) return;
    write_file_atomic(path.string(), text.replace(at, mark.size(), part));
    ++filled;
  };
  fill(reference / "configuration.md", "<!-- sections -->\n", section_tables());
  for (const PluginEntry* entry : context.registry.entries()) {
    for (const char* tree : {"framework", "plugins"})
      fill(root / tree / kind_folder(entry->kind) / entry->name / "README.md", "<!-- parameters -->\n",
           parameter_table_markdown(*entry));
  }
  print_note(context,
             "verbs.md and plugins.md written, " + std::to_string(filled) + " tables filled under " + root.string());
}

// What bash and zsh read; it runs the program at each TAB. zsh takes the file from a folder of functions too, where its
// first call completes at once.
constexpr const char* kCompletion = R"(#compdef semfield
# Completion of semfield for bash and zsh, made by `semfield help --completion`.
_semfield() {
  local IFS=$'\n'
  COMPREPLY=($("${COMP_WORDS[0]}" help --complete "${COMP_WORDS[@]:1:$COMP_CWORD}" 2>/dev/null))
}
if [[ -n ${ZSH_VERSION-} ]]; then autoload -Uz bashcompinit; bashcompinit; fi
complete -o default -F _semfield semfield
if [[ ${funcstack[1]-} == _semfield ]]; then _bash_complete -o default -F _semfield; fi
)";

int run(const HelpOptions& options, AppContext& context) {
  if (options.completion) {
    std::fputs(kCompletion, stdout);
  } else if (options.pages.empty()) {
    std::fputs(help_of(options.verb).c_str(), stdout);
  } else {
    write_pages(options.pages, context);
  }
  return 0;
}

}  // namespace

Verb verb_help() {
  return without_json(make_verb<HelpOptions>("help", 210, "print the usage of a verb", {"train", "config check"}, run));
}

// bench numerics: the stiff and extreme cases as a table or a JSON object.

namespace {

struct NumericsOptions : Options {
  using Options::Options;
  const std::vector<std::string>& only = list("--only LIST", "case ids or prefixes of them: --only A,C03");
};

// By case: failed in one precision is failed; absent only when no precision of it exists.
std::map<NumericsStatus, int> count_cases(const std::vector<NumericsRow>& rows) {
  std::map<std::string, std::set<NumericsStatus>> cases;
  for (const NumericsRow& row : rows) cases[row.id].insert(row.status);
  std::map<NumericsStatus, int> counts{
      {NumericsStatus::passed, 0}, {NumericsStatus::failed, 0}, {NumericsStatus::absent, 0}};
  for (const auto& [id, of] : cases) {
    ++counts[of.contains(NumericsStatus::failed)   ? NumericsStatus::failed
             : of.contains(NumericsStatus::passed) ? NumericsStatus::passed
                                                   : NumericsStatus::absent];
  }
  return counts;
}

const char* status_text(const NumericsRow& row) {
  switch (row.status) {
    case NumericsStatus::passed:
      return "passed";
    case NumericsStatus::absent:
      return "absent";
    case NumericsStatus::failed:
      break;
  }
  return row.known_failure.empty() ? "FAILED" : "FAILED (known)";
}

std::string number(const NumericsRow& row, double value) {
  if (row.status == NumericsStatus::absent) return "-";
  if (row.error == 0 && row.tolerance == 0) return "exact";
  return value == 0 ? "0" : fmt::format("{:.2g}", value);
}

std::string time_text(double seconds) {
  return seconds >= 1 ? fmt::format("{:.2f} s", seconds) : fmt::format("{:.2f} ms", 1e3 * seconds);
}

std::string table_of(const std::vector<NumericsRow>& rows) {
  constexpr const char* kLine = "{:<4} {:<22} {:<8} {:<18} {:>9} {:>9} {:>7} {:>10}  {}\n";
  std::string text = fmt::format(kLine, "id", "case", "", "reference", "error", "allowed", "checks", "time", "status");
  for (const NumericsRow& row : rows) {
    text += fmt::format(kLine, row.id, row.name, row.precision, row.reference, number(row, row.error),
                        number(row, row.tolerance), row.checks, time_text(row.seconds), status_text(row));
    if (row.status != NumericsStatus::failed) continue;
    text += "     " + row.note + "\n";
    if (!row.known_failure.empty()) text += "     known: " + row.known_failure + "\n";
  }
  return text;
}

Json results(const std::vector<NumericsRow>& rows, int passed, int failed, int absent) {
  Json out = {{"passed", passed}, {"failed", failed}, {"absent", absent}, {"cases", passed + failed + absent}};
  out["rows"] = Json::array();
  for (const NumericsRow& row : rows) {
    out["rows"].push_back({{"id", row.id},
                           {"name", row.name},
                           {"precision", row.precision},
                           {"what", row.what},
                           {"reference", row.reference},
                           {"error", row.error},
                           {"tolerance", row.tolerance},
                           {"checks", row.checks},
                           {"seconds", row.seconds},
                           {"status", status_text(row)},
                           {"note", row.note},
                           {"known_failure", row.known_failure}});
  }
  return out;
}

int run(const NumericsOptions& options, AppContext& context) {
  const auto suite = reinterpret_cast<NumericsSuite>(
      part_symbol("semfield_numerics", kNumericsSuiteSymbol, "the suite of numerical cases cannot be loaded"));
  std::vector<NumericsRow> rows;
  suite(context.registry, options.only, rows);
  const std::map<NumericsStatus, int> counts = count_cases(rows);
  const int passed = counts.at(NumericsStatus::passed), failed = counts.at(NumericsStatus::failed);
  const int absent = counts.at(NumericsStatus::absent);
  print_results(
      context, results(rows, passed, failed, absent),
      table_of(rows) + fmt::format("numerics: passed={} failed={} cases={}{}", passed, failed, passed + failed + absent,
                                   absent > 0 ? fmt::format(" absent={}", absent) : ""));
  return failed == 0 ? 0 : static_cast<int>(ErrorKind::failure);
}

}  // namespace

Verb verb_bench_numerics() {
  return make_verb<NumericsOptions>("bench numerics", 10, "check stiff and extreme cases against their references",
                                    {"--only A", "--only C03"}, run);
}

// bench: whole training steps, timed by a library of its own.

namespace {

// Most runs of the program do without the library. Throws Error(unavailable) where it is missing, naming what to build.
int run_bench(const char* device, const BenchOptions& options, AppContext& context) {
  const auto bench = reinterpret_cast<BenchFunction>(
      part_symbol("semfield_bench", "semfield_bench", "the measurements of `bench` cannot be loaded"));
  return bench(options, device, context);
}

}  // namespace

Verb verb_bench() {
  return make_group("bench", 180, "measure the speed of training steps, check stiff numerical cases");
}

Verb verb_bench_gpu() {
  return make_verb<BenchOptions>(
      "bench gpu", 20, "time training steps and frames on a GPU", {"", "--only room"},
      [](const BenchOptions& options, AppContext& context) { return run_bench("cuda", options, context); });
}

Verb verb_bench_step() {
  return make_verb<BenchOptions>(
      "bench step", 30, "time whole training steps on the CPU", {"--size tiny", "--size tiny --only paper"},
      [](const BenchOptions& options, AppContext& context) { return run_bench("cpu", options, context); });
}

}  // namespace semfield::app
