// Floors and never-arrows as a table.
#include "tests/architecture/include_rules.h"

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <sstream>

namespace semfield::architecture {

namespace {

using Folders = std::set<std::string>;

bool starts_with(const std::string& text, const std::string& start) { return text.rfind(start, 0) == 0; }
bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

const Folders kFrameworkFolders{"core",
                                "system",
                                "compute",
                                "config",
                                "formats",
                                "scene/classes",
                                "scene",
                                "scene/survey",
                                "loading",
                                "plugin",
                                "labels",
                                "losses",
                                "model",
                                "execution",
                                "model/optim",
                                "cuda",
                                "eval",
                                "session/settings",
                                "session",
                                "run",
                                "report",
                                "capture",
                                "objects",
                                "surface/fuse",
                                "surface/mesh",
                                "report/sweep",
                                "serve",
                                "testkit",
                                "execution/ranks",
                                "handover"};

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
      {"report/sweep", with(run, {"report", "report/sweep"})},
      {"serve", with(run, {"surface", "serve"})},
      {"testkit", kFrameworkFolders},
  };
  return table;
}

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
  return kFrameworkFolders.contains(inner) ? inner : first;
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
  if (kFrameworkFolders.contains(other) && !floor->second.contains(other)) return folder + " may not include " + other;
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
  if (!kFrameworkFolders.contains(other) || target.find('/') == std::string::npos) return {};
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

}  // namespace

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

}  // namespace semfield::architecture
