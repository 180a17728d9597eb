// Linked and loaded modules into a registry.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "core/error.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

/// Checks API number and ABI tag, then runs the module's register function; a throwing one is wrapped with the module's
/// name.
void register_module(Registry& registry, const PluginModule& module);

/// Runs a file of Python, whose plugins go into the registry.
using PythonLoader = void (*)(Registry& registry, const std::string& path);

/// check_module_file, dlopen(RTLD_NOW | RTLD_LOCAL), register_module; never unloaded. A file that the registry has
/// already is left at that. A file NAME.py is run by `python`, that of a process that is Python's, or where it is null
/// by libsemfield_python.so, which embeds it. Its code runs, so `path` comes from who started the program. What was
/// asked for by path must load: throws Error(unavailable) with a sentence that names both sides (missing file, no
/// plugin, other API, other ABI, throwing registration, duplicate name). An exception out of a static initialiser
/// cannot be caught here: it ends the program through std::terminate, whose handler may ask module_being_loaded().
void load_module(Registry& registry, const std::string& path, PythonLoader python = nullptr);

/// A module that a configuration names, which may come from anybody. What is loaded is the module of its file name that
/// lies in a trusted folder itself, not in a folder below: those of the environment variable SEMFIELD_PLUGIN_PATH,
/// absolute and separated by colons. One of its file name that load_module was given satisfies it too. Throws
/// Error(unavailable) otherwise.
void load_listed_module(Registry& registry, const std::string& path);

/// Adds the CUDA kernels of the registry's modules: for FILE.so those of FILE_cuda.so beside it, where there is one. It
/// is checked and loaded as a module is, and needs the library of CUDA kernels loaded. Throws Error(unavailable).
void add_cuda_kernels_of_modules(Registry& registry);

/// File whose static initialisers run now, in this thread; "" at any other time.
const std::string& module_being_loaded();

// The table that CMake generates from plugins/*/*.

/// Registers every plugin that this build links.
void register_linked_plugins(Registry& registry);

// The file of a loadable module, looked at before any of its code runs.

/// Throws Error(unavailable), begun with `doing`, for a file that is no shared library of this processor, that ends
/// before what it says must be mapped, that has no section kPluginSection, or whose API number or ABI tag are not ours.
void check_module_file(const std::string& path, const std::string& doing);

/// Name and checksum of each of these files, which hold plugins. Throws Error(no_input).
std::map<std::string, std::string> module_checksums(const std::vector<std::string>& files);

/// A warning for each of `files` that is another one than in `trained`, by name; a name that is not there is no news.
void warn_of_other_modules(const std::map<std::string, std::string>& trained, const std::vector<std::string>& files,
                           Diagnostics& diagnostics);

// What a check of plugins against the laws of their kinds hands over: the laws are a library of their own
// (libsemfield_laws.so, the testkit), loaded when asked for.

enum class LawStatus : std::uint8_t {
  passed,
  failed,
  refused,  ///< the plugin's factory cannot be built so, and says why; some other way must work
};

/// The laws of one plugin with one set of parameters, built in one way.
struct LawRow {
  PluginKind kind = PluginKind::encoder;
  std::string name;
  std::string settings;  ///< "bands=7", "defaults"; "" for the laws of the declaration
  std::string build;     ///< "positions", "bf16, no direction"; "" where there is one way
  LawStatus status = LawStatus::passed;
  std::vector<std::string> found;  ///< a sentence for each way in which a law was broken, or why it was refused
};

struct LawRequest {
  std::vector<const PluginEntry*> entries;
  std::string settings_file;                           ///< lines as in conformance.txt; "": the defaults
  std::vector<std::string> scene;                      ///< "root=room": parameters of the datasets among the entries
  std::string folder;                                  ///< that relative paths of `scene` start at
  std::function<void(const LawRow&)> on_begin;         ///< of a row whose laws are asked now; may be empty
  std::function<void(const std::string& law)> on_law;  ///< of the row, asked now; may be empty
  std::function<void(const LawRow&)> on_row;
};

/// The library's one symbol. Throws before any law Error(config) for a line of the file that fits no entry or that an
/// entry's parameters refuse, and Error(usage) for a dataset that cannot open a scene with these parameters.
using LawSuite = void (*)(const Registry& registry, const LawRequest& request);
inline constexpr const char* kLawSuiteSymbol = "semfield_law_suite";

}  // namespace semfield
