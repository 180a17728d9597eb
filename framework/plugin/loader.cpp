// Modules into a registry, whole or not at all.
#include "plugin/loader.h"

#include <dlfcn.h>

#include <filesystem>

namespace semfield {

namespace {

constexpr const char* kSymbol = "semfield_plugin_module";

// Throws Error(unavailable) naming both sides when `module` was not built for this framework.
void check_compatible(const PluginModule& module) {
  // The API number stands first in the descriptor and is read first: with another one the rest may have another layout.
  if (module.api != kPluginApi) {
    throw Error(ErrorKind::unavailable,
                "the module speaks plugin API " + std::to_string(module.api) + ", this framework speaks " +
                    std::to_string(kPluginApi),
                "rebuild the plugin against the installed headers");
  }
  const std::string theirs = module.abi_tag == nullptr ? "" : module.abi_tag;
  const std::string ours = abi_tag_of_framework();
  if (theirs != ours) {
    throw Error(ErrorKind::unavailable,
                "the module was built with ABI '" + theirs + "', this framework with '" + ours + "'",
                "build both with the same standard library and its options");
  }
  if (module.name == nullptr || module.version == nullptr || module.register_into == nullptr) {
    throw Error(ErrorKind::unavailable, "the module's descriptor lacks its name, version or register function",
                "end the plugin with SEMFIELD_PLUGIN_MODULE(name, version, function)");
  }
}

// The module's entries, or the registry as it was.
void register_whole(Registry& registry, const PluginModule& module) {
  const std::string title = std::string(module.name) + " " + module.version;
  Registry trial = registry;
  trial.set_current_module(title);
  try {
    module.register_into(trial);
  } catch (Error& error) {
    error.while_doing("while registering module '" + title + "'");
    throw;
  } catch (const std::exception& error) {
    throw Error(ErrorKind::unavailable, "while registering module '" + title + "': " + error.what());
  } catch (...) {
    throw Error(ErrorKind::unavailable, "while registering module '" + title + "': an unknown exception");
  }
  trial.set_current_module({});
  registry = std::move(trial);
}

}  // namespace

const char* abi_tag_of_framework() { return SEMFIELD_ABI_TAG; }

void register_module(Registry& registry, const PluginModule& module) {
  check_compatible(module);
  register_whole(registry, module);
}

void load_module(Registry& registry, const std::string& path) {
  const std::string doing = "cannot load plugin '" + path + "'";
  std::error_code ignored;
  if (!std::filesystem::is_regular_file(path, ignored)) {
    throw Error(ErrorKind::unavailable, doing + ": there is no such file",
                "check the path; it is relative to the working directory");
  }
  // A name without a slash would be searched in the library path, which is not what was asked for.
  const std::string absolute = std::filesystem::absolute(path).string();
  void* library = dlopen(absolute.c_str(), RTLD_NOW | RTLD_LOCAL);
  if (library == nullptr) {
    const char* cause = dlerror();
    throw Error(ErrorKind::unavailable, doing + ": " + (cause == nullptr ? "dlopen failed" : cause),
                "build it as a shared module against the installed framework");
  }
  // Never dlclose: entries hold functions and type tables of the module until the program ends.
  const auto* module = static_cast<const PluginModule*>(dlsym(library, kSymbol));
  if (module == nullptr) {
    throw Error(ErrorKind::unavailable, doing + ": it does not export '" + kSymbol + "'",
                "build it with SEMFIELD_LOADABLE_MODULE defined and end it with SEMFIELD_PLUGIN_MODULE(...)");
  }
  try {
    register_module(registry, *module);
  } catch (Error& error) {
    error.while_doing(doing);
    throw;
  }
}

}  // namespace semfield
