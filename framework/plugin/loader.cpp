// Modules into a registry, whole or not at all.
#include "plugin/loader.h"

#include <dlfcn.h>
#include <elf.h>
#include <link.h>

#include <cstring>
#include <filesystem>

#include "core/files.h"

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

// Throws Error(unavailable) for a library of another processor, and for one whose file ends before what it says must be
// mapped: a copy that was interrupted would end the program at the first touch of a page that is not there. Anything
// that is no ELF file is left to dlopen to refuse.
void check_library_file(const std::string& path, const std::string& doing) {
  constexpr std::size_t kLooked = std::size_t{1} << 16;
  std::string start;
  try {
    start = read_file_start(path, kLooked);
  } catch (const Error&) {
    return;  // dlopen tells why it cannot be read
  }
  ElfW(Ehdr) header{};
  if (start.size() < sizeof header || std::memcmp(start.data(), ELFMAG, SELFMAG) != 0) return;
  std::memcpy(&header, start.data(), sizeof header);
  ElfW(Ehdr) own{};
  const std::string self = read_file_start("/proc/self/exe", sizeof own);
  if (self.size() == sizeof own) std::memcpy(&own, self.data(), sizeof own);
  if (self.size() == sizeof own &&
      (header.e_ident[EI_CLASS] != own.e_ident[EI_CLASS] || header.e_machine != own.e_machine)) {
    throw Error(ErrorKind::unavailable,
                doing + ": it was built for another processor (ELF class " + std::to_string(header.e_ident[EI_CLASS]) +
                    ", machine " + std::to_string(header.e_machine) + "; this program: " +
                    std::to_string(own.e_ident[EI_CLASS]) + ", " + std::to_string(own.e_machine) + ")",
                "build it on this kind of machine");
  }
  const std::uintmax_t size = std::filesystem::file_size(path);
  for (std::size_t i = 0; i < header.e_phnum; ++i) {
    ElfW(Phdr) part{};
    const std::size_t at = header.e_phoff + i * sizeof part;
    if (at + sizeof part > start.size()) break;
    std::memcpy(&part, start.data() + at, sizeof part);
    if (part.p_type != PT_LOAD || part.p_offset + part.p_filesz <= size) continue;
    throw Error(ErrorKind::unavailable,
                doing + ": the file is cut short: it ends at byte " + std::to_string(size) + " of " +
                    std::to_string(part.p_offset + part.p_filesz),
                "copy or build it again");
  }
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
                "check the path; in a configuration it starts at the file that wrote it");
  }
  // A name without a slash would be searched in the library path, which is not what was asked for.
  const std::string absolute = std::filesystem::absolute(path).string();
  check_library_file(absolute, doing);
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
