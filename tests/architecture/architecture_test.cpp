// The floors of the house: which file may include what.

#include <gtest/gtest.h>

#include <algorithm>
#include <cctype>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <regex>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "plugin/loader.h"
#include "plugin/registry.h"
#include "tests/says.h"

namespace semfield::architecture {
namespace {

struct SourceFile {
  std::string path;  ///< relative to the project, with '/'
  std::string text;
};

struct Include {
  int line = 0;
  std::string target;  ///< between quotes or angle brackets
};

using Folders = std::set<std::string>;

bool starts_with(const std::string& text, const std::string& start) { return text.rfind(start, 0) == 0; }
bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

// A folder and those that it may include. Folders inside a folder stand on its floor, but for those that are named.
const std::map<std::string, Folders>& floors() {
  const auto with = [](Folders folders, const Folders& more) {
    folders.insert(more.begin(), more.end());
    return folders;
  };
  static const Folders ground{"core", "system", "compute"};
  static const Folders scene = with(ground, {"config", "formats", "scene/classes", "scene"});
  static const Folders loading = with(scene, {"scene/survey", "loading"});
  static const Folders model = with(scene, {"plugin", "losses", "model/optim", "model"});
  static const Folders execution = with(model, {"execution/ranks", "execution"});
  static const Folders settings =
      with(execution, {"scene/survey", "loading", "labels", "model/optim", "session/settings"});
  static const Folders run = with(settings, {"eval", "session", "run"});
  static const std::map<std::string, Folders> table{
      {"core", {"core"}},
      {"system", {"core", "system"}},
      {"execution/ranks", {"core", "system", "execution/ranks"}},
      {"compute", ground},
      {"config", with(ground, {"config"})},
      {"formats", with(ground, {"config", "formats"})},
      {"scene/classes", with(ground, {"config", "formats", "scene/classes"})},
      {"scene", scene},
      {"scene/survey", with(scene, {"scene/survey"})},
      {"loading", loading},
      {"capture", with(loading, {"capture"})},
      {"plugin", with(scene, {"plugin"})},
      {"labels", with(loading, {"plugin", "labels"})},
      {"losses", with(scene, {"plugin", "losses"})},
      {"model/optim", with(ground, {"config", "model/optim"})},
      {"model", model},
      {"execution", execution},
      {"cuda", with(execution, {"cuda"})},
      {"eval", with(execution, {"scene/survey", "loading", "labels", "eval"})},
      {"surface", with(execution, {"scene/survey", "loading", "labels", "eval", "surface"})},
      {"session/settings", settings},
      {"session", with(settings, {"eval", "session"})},
      {"run", run},
      {"report", with(run, {"report"})},
      {"surface/fuse", with(settings, {"eval", "session", "surface", "surface/fuse"})},
      {"objects", with(settings, {"eval", "session", "surface", "objects"})},
      {"surface/mesh", with(settings, {"eval", "surface", "surface/mesh"})},
      {"handover", with(settings, {"eval", "surface", "surface/mesh", "handover"})},
      {"serve", with(run, {"surface", "serve"})},
      {"testkit", {}},  // includes all of them
  };
  return table;
}
bool is_folder(const std::string& name) { return floors().contains(name); }

// Libraries with exactly one user, and those that may not enter a header.
std::string forbidden_library(const std::string& path, const std::string& target) {
  static const std::vector<std::pair<std::string, std::string>> only{
      {"yaml-cpp/", "framework/config/config_tree.cpp"},
      {"yaml.h", "framework/config/config_tree.cpp"},
      {"mpi.h", "framework/execution/ranks/mpi/mpi_ranks.cpp"},
      {"nccl.h", "framework/cuda/nccl/nccl_exchange.cpp"},
      {"OpenImageIO/", "framework/formats/image_formats.cpp"},
      {"tiny_obj_loader.h", "plugins/datasets/obj_room/mesh_io.cpp"},
      {"omp.h", "framework/compute/parallel.cpp"},
  };
  for (const auto& [library, user] : only) {
    if (starts_with(target, library) && path != user) return "only " + user + " may include " + library;
  }
  // What every --json prints; no plugin sees the program's headers.
  if (path == "app/json_output.h" && starts_with(target, "nlohmann/")) return {};
  for (const char* library : {"Eigen/", "nlohmann/", "CLI/", "fmt/", "embree"}) {
    if (starts_with(target, library) && ends_with(path, ".h"))
      return std::string(library) + " may be included by .cpp files only";
  }
  const bool gpu = starts_with(target, "cuda") || starts_with(target, "cublas");
  if (gpu && !ends_with(path, ".cu") && !ends_with(path, ".cuh") && path.find("cuda") == std::string::npos)
    return "CUDA headers belong to CUDA files";
  return {};
}

std::string first_folder(const std::string& path) { return path.substr(0, path.find('/')); }

// The folder of the framework whose floor `path` stands on: a folder inside a folder where it has a floor of its own.
std::string folder_of(const std::string& path) {
  const std::string first = first_folder(path);
  const std::size_t end = path.find('/', first.size() + 1);
  const std::string inner = end == std::string::npos ? first : path.substr(0, end);
  return is_folder(inner) ? inner : first;
}

bool names_plugin(const std::string& target) {
  for (const char* kind :
       {"encoders/", "fields/", "samplers/", "datasets/", "label_readers/", "degradations/", "groupings/", "fused/"}) {
    if (starts_with(target, kind)) return true;
  }
  return starts_with(target, "plugins/");
}

std::string forbidden_in_framework(const std::string& path, const std::string& target) {
  const std::string folder = folder_of(path);
  if (names_plugin(target)) return "the framework includes no plugin";
  for (const char* above : {"app/", "tests/"}) {
    if (starts_with(target, above)) return "the framework includes neither the application nor tests";
  }
  const std::string other = folder_of(target);
  const auto floor = floors().find(folder);
  if (floor == floors().end()) return "framework/" + folder + " stands on no floor of the table";
  // Kernels of a loss lie beside it.
  if (folder == "losses" && other == "cuda" && ends_with(path, "_cuda.cu")) return {};
  if (folder != "testkit" && is_folder(other) && !floor->second.contains(other))
    return folder + " may not include " + other;
  return {};
}

// `inside` = "encoders/hash_grid/hash_grid.h".
std::string forbidden_in_plugin(const std::string& inside, const std::string& target) {
  const std::string kind = first_folder(inside);
  const std::string own = inside.substr(0, inside.find('/', kind.size() + 1) + 1);
  if (starts_with(target, own)) return {};
  if (names_plugin(target)) {
    if (kind == "fused" && ends_with(target, "_math.h")) return {};
    return "a plugin includes no other plugin";
  }
  const std::string other = folder_of(target);
  if (!is_folder(other) || target.find('/') == std::string::npos) return {};
  static const Folders sdk{"core", "system", "compute", "plugin"};
  static const Folders of_scenes{"formats", "scene/classes", "scene", "scene/survey", "loading"};
  if (sdk.contains(other) || target == "config/params.h") return {};
  const bool of_labels = kind == "label_readers" || kind == "degradations";
  if ((of_scenes.contains(other) || target == "config/config_tree.h") && (kind == "datasets" || of_labels)) return {};
  if (other == "labels" && of_labels) return {};
  if (other == "cuda" && (ends_with(inside, ".cu") || ends_with(inside, ".cuh"))) return {};
  if (kind == "fused" && target == "model/encoded_field.h") return {};
  return "a plugin sees core, system, compute, config/params.h, plugin" +
         std::string(kind == "datasets" || of_labels ? " and the folders of scenes, config/config_tree.h" : "") +
         " alone";
}

/// Every file under the project's `folder` whose name ends in one of `endings`, by path.
std::vector<SourceFile> files_under(const std::string& folder, const std::vector<std::string>& endings) {
  const std::filesystem::path root = SEMFIELD_SOURCE_DIR;
  std::vector<SourceFile> files;
  if (!std::filesystem::exists(root / folder)) return files;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(root / folder)) {
    const std::string path = std::filesystem::relative(entry.path(), root).generic_string();
    const bool wanted =
        std::any_of(endings.begin(), endings.end(), [&](const std::string& ending) { return ends_with(path, ending); });
    if (!entry.is_regular_file() || !wanted) continue;
    std::ifstream file(entry.path());
    std::ostringstream text;
    text << file.rdbuf();
    files.push_back({path, text.str()});
  }
  std::sort(files.begin(), files.end(), [](const SourceFile& a, const SourceFile& b) { return a.path < b.path; });
  return files;
}

std::vector<Include> includes_of(const std::string& text) {
  std::vector<Include> found;
  std::istringstream lines(text);
  int number = 0;
  for (std::string line; std::getline(lines, line);) {
    ++number;
    const std::size_t hash = line.find_first_not_of(" \t");
    if (hash == std::string::npos || line[hash] != '#') continue;
    const std::size_t word = line.find_first_not_of(" \t", hash + 1);
    if (word == std::string::npos || line.compare(word, 7, "include") != 0) continue;
    const std::size_t open = line.find_first_of("\"<", word);
    const std::size_t close = open == std::string::npos ? open : line.find_first_of("\">", open + 1);
    if (close != std::string::npos) found.push_back({number, line.substr(open + 1, close - open - 1)});
  }
  return found;
}

/// "" when the file at `path` may include `target`, else the rule that forbids it.
std::string why_forbidden(const std::string& path, const std::string& target) {
  if (std::string why = forbidden_library(path, target); !why.empty()) return why;
  // A test beside a plugin or a term of the loss may use the testkit and whatever else it needs to feed it.
  const bool of_a_test =
      ends_with(path, "_test.cpp") || ends_with(path, "_sample.cpp") || path.find("/tests/") != std::string::npos;
  if (starts_with(path, "framework/") && !of_a_test)
    return forbidden_in_framework(path.substr(std::string("framework/").size()), target);
  if (starts_with(path, "plugins/") && !of_a_test)
    return forbidden_in_plugin(path.substr(std::string("plugins/").size()), target);
  if (starts_with(path, "app/") && names_plugin(target))
    return "the application knows plugins by their names in the registry alone";
  if (starts_with(path, "app/") && starts_with(target, "testkit/")) return "the application does not use the testkit";
  return {};
}

// Every include of the house keeps to the floors; the rules themselves are tried on known violations.

const std::vector<std::string> kSources{".h", ".cpp", ".cu", ".cuh"};

void check_folder(const std::string& folder, std::size_t at_least) {
  std::size_t count = 0;
  for (const SourceFile& file : files_under(folder, kSources)) {
    for (const Include& include : includes_of(file.text)) {
      ++count;
      const std::string why = why_forbidden(file.path, include.target);
      EXPECT_EQ(why, "") << file.path << ":" << include.line << " includes " << include.target;
    }
  }
  EXPECT_GE(count, at_least) << "hardly any include was read under " << folder;
}

TEST(IncludeArrows, FrameworkKeepsItsFloors) { check_folder("framework", 100); }
TEST(IncludeArrows, PluginsSeeTheSdkAlone) { check_folder("plugins", 50); }
TEST(IncludeArrows, TheApplicationStandsOnTop) { check_folder("app", 1); }
TEST(IncludeArrows, TestsKeepTheLibrariesApart) { check_folder("tests", 20); }

struct Arrow {
  const char* path;
  const char* target;
};

TEST(IncludeRules, KnownViolationsAreForbidden) {
  const Arrow violations[] = {
      {"framework/core/view.h", "config/params.h"},
      {"framework/system/files.cpp", "compute/parallel.h"},
      {"framework/scene/classes/class_table.h", "scene/scene.h"},
      {"framework/config/compose.cpp", "yaml-cpp/yaml.h"},
      {"framework/scene/camera.cpp", "tiny_obj_loader.h"},
      {"framework/plugin/encoder.h", "Eigen/Core"},
      {"framework/execution/pipeline.cpp", "encoders/hash_grid/hash_grid.h"},
      {"framework/execution/pipeline.cpp", "session/trainer.h"},
      {"framework/losses/depth/depth.cpp", "cuda/kernels/device_code.cuh"},
      {"framework/session/trainer.cpp", "testkit/laws.h"},
      {"framework/session/trainer.cpp", "omp.h"},
      {"framework/surprise/new.cpp", "core/view.h"},
      {"framework/surface/fuse/fusion.cpp", "report/report.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "encoders/frequency/frequency_math.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "scene/scene.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "config/config_tree.h"},
      {"plugins/encoders/hash_grid/hash_grid_kernels.h", "cuda_runtime.h"},
      {"plugins/label_readers/clicks/clicks.cpp", "eval/evaluator.h"},
      {"plugins/losses/mine/mine.cpp", "losses/depth/depth.h"},
      {"app/main.cpp", "encoders/hash_grid/hash_grid.h"},
      {"app/verb.h", "CLI/CLI.hpp"},
  };
  for (const Arrow& arrow : violations)
    EXPECT_NE(why_forbidden(arrow.path, arrow.target), "") << arrow.path << " -> " << arrow.target;
}

TEST(IncludeRules, KnownArrowsAreAllowed) {
  const Arrow allowed[] = {
      {"framework/config/config_tree.cpp", "yaml-cpp/yaml.h"},
      {"framework/session/trainer.cpp", "execution/pipeline.h"},
      {"framework/losses/depth/depth_cuda.cu", "cuda/kernels/device_code.cuh"},
      {"framework/testkit/laws.cpp", "session/trainer.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "encoders/hash_grid/hash_grid_kernels.h"},
      {"plugins/datasets/replica/replica.cpp", "loading/frame_files.h"},
      {"plugins/fused/hash_mlp/hash_mlp.cpp", "encoders/hash_grid/hash_grid_math.h"},
      {"plugins/encoders/hash_grid/hash_grid_test.cpp", "testkit/laws.h"},
  };
  for (const Arrow& arrow : allowed)
    EXPECT_EQ(why_forbidden(arrow.path, arrow.target), "") << arrow.path << " -> " << arrow.target;
}

TEST(IncludeRules, IncludesAreReadFromText) {
  const std::vector<Include> found =
      includes_of("// #include \"no.h\"\n#include <a/b.h>\n  #  include \"c.h\"\nint x;\n#define X \"y\"\n");
  ASSERT_EQ(found.size(), 2u);
  EXPECT_EQ(found[0].target, "a/b.h");
  EXPECT_EQ(found[0].line, 2);
  EXPECT_EQ(found[1].target, "c.h");
}

// Framework and program name no plugin: what a plugin is and takes comes from its interface.

// English words too: they count where they stand for the plugin, as the whole of a text or behind `type:`.
const std::set<std::string> kWords{"frequency", "identity", "importance", "packed", "propagation", "stratified"};

// COLMAP is a program too, which these run, and whose files they read.
bool means_the_program(const std::string& file, const std::string& plugin) {
  return plugin == "colmap" &&
         (file.starts_with("framework/loading/capture/") || file.starts_with("framework/loading/colmap_"));
}

bool part_of_name(char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; }

bool stands_alone(const std::string& text, std::size_t at, std::size_t size) {
  return (at == 0 || !part_of_name(text[at - 1])) && (at + size == text.size() || !part_of_name(text[at + size]));
}

bool quoted(const std::string& text, std::size_t at, std::size_t size) {
  const char before = at == 0 ? ' ' : text[at - 1], after = at + size == text.size() ? ' ' : text[at + size];
  return (before == '"' || before == '\'') && after == before;
}

bool behind_type(const std::string& text, std::size_t at) {
  while (at > 0 && text[at - 1] == ' ') --at;
  return at >= 5 && (text.compare(at - 5, 5, "type:") == 0 || text.compare(at - 5, 5, "type=") == 0);
}

/// The class's name: nerf_mlp, NerfMlp.
std::string class_of(const std::string& name) {
  std::string out;
  for (std::size_t i = 0; i < name.size(); ++i) {
    if (name[i] == '_') continue;
    const bool first = i == 0 || name[i - 1] == '_';
    out += first ? static_cast<char>(std::toupper(static_cast<unsigned char>(name[i]))) : name[i];
  }
  return out;
}

/// Lines of `text` that name the plugin.
std::vector<int> lines_naming(const std::string& text, const std::string& plugin) {
  std::vector<int> lines;
  const auto look_for = [&](const std::string& name, const auto& counts) {
    for (std::size_t at = text.find(name); at != std::string::npos; at = text.find(name, at + 1)) {
      if (stands_alone(text, at, name.size()) && counts(at))
        lines.push_back(
            static_cast<int>(std::count(text.begin(), text.begin() + static_cast<std::ptrdiff_t>(at), '\n')) + 1);
    }
  };
  const bool word = kWords.contains(plugin);
  look_for(plugin, [&](std::size_t at) { return !word || quoted(text, at, plugin.size()) || behind_type(text, at); });
  if (plugin.find('_') != std::string::npos) look_for(class_of(plugin), [](std::size_t) { return true; });
  return lines;
}

TEST(PluginNames, FrameworkAndProgramNameNoPlugin) {
  Registry registry;
  register_linked_plugins(registry);
  ASSERT_GT(registry.entries().size(), 8u);
  std::vector<SourceFile> files;
  for (const char* folder : {"framework", "app"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files.push_back(std::move(file));
  }
  ASSERT_GT(files.size(), 200u);
  for (const SourceFile& file : files) {
    for (const PluginEntry* entry : registry.entries()) {
      const std::string own = "framework/" + std::string(kind_folder(entry->kind)) + "/" + entry->name;
      if (!files_under(own, {".cpp"}).empty()) continue;      // it comes with the framework
      if (entry->kind == PluginKind::label_reader) continue;  // named as the file format, which others write
      if (means_the_program(file.path, entry->name)) continue;
      for (const int line : lines_naming(file.text, entry->name)) {
        ADD_FAILURE() << file.path << ':' << line << " names the " << kind_name(entry->kind) << " '" << entry->name
                      << '\'';
      }
    }
  }
}

TEST(PluginNames, ANameIsFoundInTextsCommentsAndClasses) {
  EXPECT_EQ(lines_naming("a\nb \"tiny_mlp\" c", "tiny_mlp"), std::vector<int>{2});
  EXPECT_EQ(lines_naming("// fitted to tiny_mlp, TinyMlp", "tiny_mlp").size(), 2u);
  EXPECT_EQ(lines_naming("my_tiny_mlps, tiny_mlp_x", "tiny_mlp").size(), 0u);
  EXPECT_EQ(lines_naming("{type: packed} 'packed' \"packed\" type=packed", "packed").size(), 4u);
  EXPECT_EQ(lines_naming("rows are packed; packed(x)", "packed").size(), 0u);
}

// A file that calls the standard library includes the header, or includes one of ours that does: which headers bring
// others along differs from library to library, and from version to version.

using Files = std::map<std::string, std::string>;  // text by path

const std::map<std::string, std::vector<std::string>>& calls_of_headers() {
  static const std::map<std::string, std::vector<std::string>> table{
      {"algorithm",
       {"sort(",           "stable_sort(", "nth_element(",   "partial_sort(", "any_of(",       "all_of(",
        "none_of(",        "find_if(",     "count(",         "count_if(",     "clamp(",        "reverse(",
        "unique(",         "remove_if(",   "lower_bound(",   "upper_bound(",  "max_element(",  "min_element(",
        "minmax_element(", "transform(",   "rotate(",        "equal(",        "fill(",         "fill_n(",
        "copy(",           "copy_n(",      "binary_search(", "is_sorted(",    "ranges::sort(", "max({",
        "min({",           "find("}},
      {"numeric", {"accumulate(", "iota(", "inner_product(", "partial_sum(", "midpoint(", "gcd("}},
      {"cmath",
       {"sqrt(", "exp(", "log(", "log2(", "pow(", "floor(", "ceil(", "lround(", "isfinite(", "isnan(", "fma("}},
      {"cstring", {"memcpy(", "memset(", "memcmp(", "memmove(", "strlen(", "strcmp(", "strerror("}},
      {"cstdlib", {"getenv(", "system(", "malloc(", "free(", "strtod(", "strtol(", "_Exit("}},
      {"cstdio", {"printf(", "fprintf(", "snprintf(", "fopen(", "fclose(", "fputs(", "rename("}},
      {"limits", {"numeric_limits<"}},
      {"functional", {"function<"}},
      {"memory", {"unique_ptr<", "shared_ptr<", "make_unique<", "make_shared<"}},
      {"atomic", {"atomic<"}},
      {"mutex", {"mutex ", "lock_guard<", "unique_lock<"}},
  };
  return table;
}

/// What a file includes, itself or through files of ours, with their paths.
void collect(const Files& files, const std::string& path, std::set<std::string>& included) {
  for (const Include& include : includes_of(files.at(path))) {
    bool ours = false;
    const std::string beside = std::filesystem::path(path).parent_path().string() + "/";
    for (const std::string& root : {beside, std::string("framework/"), std::string("plugins/"), std::string()}) {
      if (!files.contains(root + include.target)) continue;
      ours = true;
      if (included.insert(root + include.target).second) collect(files, root + include.target, included);
    }
    if (!ours) included.insert(include.target);
  }
}

TEST(StandardHeaders, AreIncludedByThoseWhoCallThem) {
  Files files;
  for (const char* folder : {"framework", "plugins", "app", "tests"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files[file.path] = std::move(file.text);
  }
  EXPECT_GT(files.size(), 300u);
  for (const auto& [path, text] : files) {
    std::set<std::string> included;
    collect(files, path, included);
    for (const auto& [header, calls] : calls_of_headers()) {
      if (included.contains(header)) continue;
      for (const std::string& call : calls) {
        if (text.find("std::" + call) != std::string::npos)
          ADD_FAILURE() << path << " has std::" << call << " and no #include <" << header << ">";
      }
    }
  }
}

// Rules on the text of sources: length, the CUDA switch, fast math.

std::vector<SourceFile> all_sources() {
  std::vector<SourceFile> files;
  for (const char* folder : {"framework", "plugins", "app", "tests"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files.push_back(std::move(file));
  }
  return files;
}

TEST(SourceRules, OneFileTestsForTheCudaCompiler) {
  const std::string word = std::string("__CUDA") + "CC__";
  int users = 0;
  for (const SourceFile& file : all_sources()) {
    if (file.text.find(word) == std::string::npos) continue;
    ++users;
    EXPECT_EQ(file.path, "framework/core/host_device.h");
  }
  EXPECT_EQ(users, 1);
}

TEST(SourceRules, ParallelSectionsLiveInOneFile) {
  const std::string word = std::string("#pragma ") + "omp";
  for (const SourceFile& file : all_sources()) {
    if (file.text.find(word) == std::string::npos) continue;
    EXPECT_EQ(file.path, "framework/compute/parallel.cpp");
  }
}

TEST(SourceRules, AHeaderOpensWithASentence) {
  for (const SourceFile& file : all_sources()) {
    if (file.path.substr(file.path.size() - 2) != ".h") continue;
    EXPECT_EQ(file.text.rfind("//", 0), 0u) << file.path << " does not open by saying what it is";
  }
}

// Lines that give a process or a thread something that changes: thread_local, variables g_... and t_..., and statics of
// functions that are no constants.
bool keeps_state(const std::string& line) {
  static const std::regex state(
      R"(^(\s*(static )?thread_local\b.*)"
      R"(|(static |volatile )?[A-Za-z_][\w:<>, ]*[ &*]+[gt]_\w+(\{.*|;.*| = .*))"
      R"(|\s*static (?!const\b|constexpr\b|inline\b|thread_local\b)[\w:<>, ]+[ &*]+(const )?\w+(;| =|\{).*)$)");
  return std::regex_match(line, state);
}

TEST(SourceRules, StateOfTheProcessIsListed) {
  std::ifstream file(std::string(SEMFIELD_SOURCE_DIR) + "/docs/reference/inside.md");
  const std::string page{std::istreambuf_iterator<char>(file), {}};
  const std::size_t begin = page.find("## State of the process");
  ASSERT_NE(begin, std::string::npos);
  const std::string section = page.substr(begin, page.find("\n## ", begin + 1) - begin);
  std::set<std::string> found;
  for (const char* folder : {"framework", "plugins", "app"}) {
    for (const SourceFile& source : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) {
      if (source.path.ends_with("_test.cpp") || source.path.find("/tests/") != std::string::npos) continue;
      std::istringstream lines(source.text);
      for (std::string line; std::getline(lines, line);) {
        if (!keeps_state(line)) continue;
        const std::filesystem::path path(source.path);
        const std::string name = path.parent_path().filename().string() + "/" + path.filename().string();
        found.insert(name);
        EXPECT_HAS(section, "`" + name + "`")
            << source.path << " keeps state of the process, which docs/reference/inside.md does not list: " << line;
      }
    }
  }
  std::set<std::string> listed;
  const std::regex file_in_row(R"(`(\w+/\w+\.\w+)`)");
  std::istringstream rows(section);
  for (std::string row; std::getline(rows, row);) {
    const std::string where = row.starts_with("| `") ? row.substr(0, row.find(" | ")) : "";
    for (auto it = std::sregex_iterator(where.begin(), where.end(), file_in_row); it != std::sregex_iterator(); ++it)
      listed.insert((*it)[1]);
  }
  EXPECT_EQ(listed, found);
}

TEST(SourceRules, StateIsRecognised) {
  for (const char* line : {"Workspace g_scratch;", "thread_local bool t_inside = false;", "  static bool on = true;",
                           "  static Library* const only = new Library;", "volatile std::sig_atomic_t g_save = 0;",
                           "  static Teams& all = *new Teams;", "thread_local KeptBlocks* blocks_of_call = nullptr;",
                           "  static std::map<int, int> cache;"}) {
    EXPECT_TRUE(keeps_state(line)) << line;
  }
  for (const char* line : {"  static const int quota = cpu_quota();", "  static constexpr int kBits = 3;",
                           "  static std::string file_name(std::int64_t step);", "  g_save = 1;",
                           "  static void add(Sums& sums) {", "  const double g_at = f(1);"}) {
    EXPECT_FALSE(keeps_state(line)) << line;
  }
}

// Flags that let the compiler believe that there is no NaN: they would delete every finite check.
std::vector<std::string> fast_math_in(const std::string& text) {
  std::vector<std::string> found;
  for (const char* flag :
       {"-ffast-math", "-Ofast", "-funsafe-math", "-fassociative-math", "-freciprocal-math", "-ffinite-math-only",
        "-fno-honor-nans", "-fno-honor-infinities", "-fno-signed-zeros", "-ffp-model=fast", "-fp-model fast",
        "/fp:fast", "use_fast_math", "-cl-fast-relaxed-math", "optimize(\"fast-math"}) {
    if (text.find(flag) != std::string::npos) found.emplace_back(flag);
  }
  return found;
}

TEST(SourceRules, NoBuildFileAsksForFastMath) {
  std::vector<SourceFile> files;
  for (const char* folder : {"cmake", "framework", "plugins", "app", "tests", "scripts", ".ci"}) {
    for (SourceFile& file :
         files_under(folder, {"CMakeLists.txt", ".cmake", ".cmake.in", ".json", ".yml", ".yaml", ".sh"}))
      files.push_back(std::move(file));
  }
  for (const char* script : {"scripts/setup", "scripts/test", "scripts/demo", "CMakeLists.txt", "CMakePresets.json"}) {
    std::ifstream file(std::string(SEMFIELD_SOURCE_DIR) + "/" + script);
    ASSERT_TRUE(file) << script;
    files.push_back({script, {std::istreambuf_iterator<char>(file), {}}});
  }
  EXPECT_GT(files.size(), 10u);
  for (const SourceFile& file : files) {
    for (const std::string& flag : fast_math_in(file.text)) ADD_FAILURE() << file.path << " has " << flag;
  }
}

TEST(SourceRules, NoSourceTurnsFastMathOn) {
  // Two files name the flags because they search for them: this one in sources, the other in the commands of a build.
  const std::set<std::string> searches{"tests/architecture/architecture_test.cpp", "tests/numerics/backend_cases.cpp"};
  for (const SourceFile& file : all_sources()) {
    if (searches.contains(file.path)) continue;
    for (const std::string& flag : fast_math_in(file.text)) ADD_FAILURE() << file.path << " has " << flag;
  }
}

TEST(SourceRules, FastMathIsRecognised) {
  EXPECT_EQ(fast_math_in("add_compile_options(-O3 -ffast-math)").size(), 1u);
  EXPECT_EQ(fast_math_in("\"CMAKE_CUDA_FLAGS\": \"--use_fast_math\"").size(), 1u);
  EXPECT_TRUE(fast_math_in("-O3 -ffp-contract=off -fno-math-errno").empty());
}

}  // namespace
}  // namespace semfield::architecture
