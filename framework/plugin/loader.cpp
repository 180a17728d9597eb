// Modules into a registry, whole or not at all.
#include "plugin/loader.h"

#include <dlfcn.h>
#include <elf.h>
#include <fmt/format.h>
#include <link.h>

#include <algorithm>
#include <array>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <string_view>

#include "core/checksum.h"
#include "core/files.h"
#include "core/process.h"
#include "core/text.h"

namespace semfield {

namespace {

[[noreturn]] void fail(Code code, const std::string& what, const std::string& remedy = {}) {
  throw Error(ErrorKind::unavailable, code, what, remedy);
}

constexpr const char* kSymbol = "semfield_plugin_module";
constexpr const char* kCudaSymbol = "semfield_plugin_cuda_kernels";

thread_local std::string t_being_loaded;  // NOLINT: for a handler of std::terminate, which gets no argument

// An exception of a static initialiser ends here, in the handler of std::terminate: glibc is half done. Through a
// pointer, since its declaration says that dlopen throws nothing, and the compiler would let the exception pass.
void* open_or_terminate(const char* file) noexcept {
  void* (*volatile const open)(const char*, int) = dlopen;
  return open(file, RTLD_NOW | RTLD_LOCAL);
}

// A library whose stamp is ours. Never dlclose: entries hold functions and type tables of it until the program ends.
void* open_library(const std::string& file, const std::string& asked_for, const std::string& doing,
                   const std::string& remedy) {
  check_module_file(file, doing);
  t_being_loaded = asked_for;
  void* library = open_or_terminate(file.c_str());
  t_being_loaded.clear();
  if (library != nullptr) return library;
  const char* cause = dlerror();
  fail("plugin.module.unloadable", doing + ": " + (cause == nullptr ? "dlopen failed" : cause), remedy);
}

void* symbol_of(void* library, const char* name, const std::string& doing, const std::string& remedy) {
  if (void* const found = dlsym(library, name)) return found;
  fail("plugin.module.descriptor", doing + ": it does not export '" + name + "'", remedy);
}

std::string file_name(const std::string& path) { return fs::path(path).filename().string(); }

// One spelling a file, links resolved.
std::string real_path(const fs::path& path) {
  std::error_code none;
  const fs::path whole = fs::weakly_canonical(path, none);
  return (none ? fs::absolute(path).lexically_normal() : whole).string();
}

std::vector<std::string> trusted_folders() {
  std::vector<std::string> folders;
  const char* const listed = std::getenv("SEMFIELD_PLUGIN_PATH");
  for (const std::string_view folder : parts_of(listed == nullptr ? "" : listed, ':')) {
    if (folder.empty()) continue;
    if (!fs::path(folder).is_absolute())
      fail("config.environment.value", "SEMFIELD_PLUGIN_PATH: '" + std::string(folder) + "' is not an absolute path",
           "name folders from the root, separated by colons");
    folders.push_back(real_path(folder));
  }
  return folders;
}

// That of the library which embeds Python (python/host).
PythonLoader embedded_python(const std::string& doing) {
  static const auto load = reinterpret_cast<PythonLoader>(
      library_symbol("libsemfield_python.so", "semfield_load_python", doing + ": it is a file of Python, which needs",
                     "install the package python3-semfield, or build with SEMFIELD_WITH_PYTHON=ON"));
  return load;
}

}  // namespace

const char* abi_tag_of_framework() { return SEMFIELD_ABI_TAG; }

void check_interface(int api, const std::string& abi_tag) {
  if (api != kPluginApi) {
    fail(
        "plugin.module.api",
        "the module speaks plugin API " + std::to_string(api) + ", this framework speaks " + std::to_string(kPluginApi),
        "rebuild the plugin against the installed headers");
  }
  const std::string ours = abi_tag_of_framework();
  if (abi_tag != ours) {
    fail("plugin.module.abi", "the module was built with ABI '" + abi_tag + "', this framework with '" + ours + "'",
         "build both with the same standard library and its options");
  }
}

void register_module(Registry& registry, const PluginModule& module) {
  // The API number stands first in the descriptor and is read first: with another one the rest may have another layout.
  check_interface(module.api, module.api != kPluginApi || module.abi_tag == nullptr ? "" : module.abi_tag);
  if (module.name == nullptr || module.version == nullptr || module.register_into == nullptr) {
    fail("plugin.module.descriptor", "the module's descriptor lacks its name, version or register function",
         "end the plugin with SEMFIELD_PLUGIN_MODULE(name, version, function)");
  }
  // The module's entries, or the registry as it was.
  const std::string title = std::string(module.name) + " " + module.version;
  const std::string doing = "while registering module '" + title + "'";
  Registry trial = registry;
  trial.set_current_module(title);
  try {
    module.register_into(trial);
  } catch (Error& error) {
    error.while_doing(doing);
    throw;
  } catch (const std::exception& error) {
    fail("plugin.module.registration", doing + ": " + error.what());
  } catch (...) {
    fail("plugin.module.registration", doing + ": an unknown exception");
  }
  trial.set_current_module({});
  registry = std::move(trial);
}

void load_module(Registry& registry, const std::string& path, PythonLoader python) {
  const std::string doing = "cannot load plugin '" + path + "'";
  if (!is_file(path)) {
    fail("plugin.module.missing", doing + ": there is no such file",
         "check the path; in a configuration it starts at the file that wrote it");
  }
  // Absolute: a name without a slash would be searched in the library path, which is not what was asked for.
  const std::string file = real_path(path);
  for (const std::string& loaded : registry.module_files()) {
    if (loaded == file) return;
  }
  if (file.ends_with(".py")) {
    (python != nullptr ? python : embedded_python(doing))(registry, file);
    return;
  }
  void* const library = open_library(file, path, doing, "build it as a shared module against the installed framework");
  const auto* const module = static_cast<const PluginModule*>(
      symbol_of(library, kSymbol, doing,
                "build it with SEMFIELD_LOADABLE_MODULE defined and end it with SEMFIELD_PLUGIN_MODULE(...)"));
  try {
    register_module(registry, *module);
  } catch (Error& error) {
    error.while_doing(doing);
    throw;
  }
  registry.add_module_file(file);
}

void load_listed_module(Registry& registry, const std::string& path) {
  for (const std::string& loaded : registry.module_files()) {
    if (file_name(loaded) == file_name(path)) return;
  }
  for (const std::string& trusted : trusted_folders()) {
    const std::string file = (fs::path(trusted) / file_name(path)).string();
    if (!is_file(file)) continue;
    load_module(registry, file);
    return;
  }
  if (!is_file(path))
    fail("plugin.module.missing", "cannot load plugin '" + path + "': there is no such file",
         "check the path, which starts at the file that wrote it, or name the module where it lies: --plugin FILE");
  fail("plugin.module.untrusted",
       "the module '" + path + "' was not loaded: it is code, and a configuration alone does not make it run",
       "if you trust it, add --plugin " + path +
           " (in Python: semfield.load_plugin), or set SEMFIELD_PLUGIN_PATH to a folder that holds it");
}

void add_cuda_kernels_of_modules(Registry& registry) {
  for (const std::string& module : registry.module_files()) {
    const fs::path path(module);
    const std::string file =
        (path.parent_path() / (path.stem().string() + "_cuda" + path.extension().string())).string();
    if (!is_file(file)) continue;
    const std::string doing = "cannot load the CUDA kernels '" + file + "' of plugin '" + module + "'";
    const std::string remedy = "build them again against the installed framework, or set runtime.device: cpu";
    void* const library = open_library(file, file, doing, remedy);
    auto* const add = reinterpret_cast<void (*)(KernelTables&)>(symbol_of(library, kCudaSymbol, doing, remedy));
    add(registry.kernels());
  }
}

const std::string& module_being_loaded() { return t_being_loaded; }

// The ELF file of a loadable module: processor, length, and the stamp in its own section.

namespace {

constexpr std::size_t kMostSections = 65535, kMostNames = std::size_t{1} << 24;

// Pieces of the file by offset; a piece that is not all there counts as none.
class ModuleFile {
 public:
  ModuleFile(const std::string& path, std::string doing)
      : doing_(std::move(doing)), file_(path, std::ios::binary), size_(fs::file_size(path)) {
    if (!file_) refuse("plugin.module.unreadable", "it cannot be opened", "check its permissions");
  }

  [[noreturn]] void refuse(Code code, const std::string& why, const std::string& remedy) const {
    fail(code, doing_ + ": " + why, remedy);
  }
  void require(std::uint64_t end) const {
    if (end > size_)
      refuse("plugin.module.damaged",
             "the file is cut short: it ends at byte " + std::to_string(size_) + " of " + std::to_string(end),
             "copy or build it again");
  }
  template <class T>
  T at(std::uint64_t offset) {
    T value{};
    read(offset, &value, sizeof value);
    return value;
  }
  void read(std::uint64_t offset, void* out, std::size_t bytes) {
    if (offset > size_ || bytes > size_ - offset) require(offset > ~bytes ? ~std::uint64_t{0} : offset + bytes);
    file_.seekg(static_cast<std::streamoff>(offset));
    file_.read(static_cast<char*>(out), static_cast<std::streamsize>(bytes));
    if (!file_) refuse("plugin.module.unreadable", "it cannot be read", "check the disk");
  }
  std::uint64_t size() const { return size_; }

 private:
  std::string doing_;
  std::ifstream file_;
  std::uint64_t size_;
};

void check_processor(const ModuleFile& file, const ElfW(Ehdr) & header) {
  ElfW(Ehdr) own{};
  std::ifstream program("/proc/self/exe", std::ios::binary);
  if (!program.read(reinterpret_cast<char*>(&own), sizeof own)) return;
  if (header.e_ident[EI_CLASS] == own.e_ident[EI_CLASS] && header.e_ident[EI_DATA] == own.e_ident[EI_DATA] &&
      header.e_machine == own.e_machine)
    return;
  file.refuse("plugin.module.processor",
              "it was built for another CPU (ELF class " + std::to_string(header.e_ident[EI_CLASS]) + ", machine " +
                  std::to_string(header.e_machine) + "; this program: " + std::to_string(own.e_ident[EI_CLASS]) + ", " +
                  std::to_string(own.e_machine) + ")",
              "build it on this kind of machine");
}

// A copy that was interrupted would end the program at the first touch of a page that is not there.
void check_length(ModuleFile& file, const ElfW(Ehdr) & header) {
  for (std::size_t i = 0; i < header.e_phnum; ++i) {
    const auto part = file.at<ElfW(Phdr)>(header.e_phoff + i * sizeof(ElfW(Phdr)));
    if (part.p_type == PT_LOAD) file.require(part.p_offset + part.p_filesz);
  }
  file.require(header.e_shoff + std::uint64_t{header.e_shnum} * sizeof(ElfW(Shdr)));
}

PluginStamp stamp_of(ModuleFile& file, const ElfW(Ehdr) & header) {
  const auto section = [&](std::size_t i) { return file.at<ElfW(Shdr)>(header.e_shoff + i * sizeof(ElfW(Shdr))); };
  if (header.e_shoff != 0 && header.e_shstrndx < header.e_shnum && header.e_shnum <= kMostSections) {
    const ElfW(Shdr) about_names = section(header.e_shstrndx);
    std::string names(std::min<std::size_t>(about_names.sh_size, kMostNames), '\0');
    file.read(about_names.sh_offset, names.data(), names.size());
    for (std::size_t i = 0; i < header.e_shnum; ++i) {
      const ElfW(Shdr) s = section(i);
      if (s.sh_name >= names.size() || names.c_str() + s.sh_name != std::string_view(kPluginSection)) continue;
      if (s.sh_type != SHT_PROGBITS || s.sh_size < sizeof(PluginStamp)) break;
      return file.at<PluginStamp>(s.sh_offset);
    }
  }
  file.refuse("plugin.module.foreign",
              std::string("it has no section '") + kPluginSection +
                  "', so it is not a plugin, or it was built before modules had one",
              "build it with SEMFIELD_LOADABLE_MODULE defined and end it with SEMFIELD_PLUGIN_MODULE(...)");
}

}  // namespace

void check_module_file(const std::string& path, const std::string& doing) {
  ModuleFile file(path, doing);
  if (file.size() < SELFMAG || std::memcmp(file.at<std::array<char, SELFMAG>>(0).data(), ELFMAG, SELFMAG) != 0)
    file.refuse("plugin.module.foreign", "it is not a shared library", "check that it is the right file");
  const auto header = file.at<ElfW(Ehdr)>(0);
  check_processor(file, header);
  if (header.e_type != ET_DYN)
    file.refuse("plugin.module.foreign", "it is not a shared library", "check that it is the right file");
  check_length(file, header);
  const PluginStamp stamp = stamp_of(file, header);
  const PluginStamp ours{};
  if (std::memcmp(stamp.magic, ours.magic, sizeof ours.magic) != 0)
    file.refuse("plugin.module.foreign", std::string("its section '") + kPluginSection + "' holds something else",
                "end the plugin with SEMFIELD_PLUGIN_MODULE(name, version, function)");
  const std::string tag(stamp.abi_tag, strnlen(stamp.abi_tag, sizeof stamp.abi_tag));
  try {
    check_interface(stamp.api, tag);
  } catch (Error& error) {
    throw error.while_doing(doing);
  }
}

std::map<std::string, std::string> module_checksums(const std::vector<std::string>& files) {
  std::map<std::string, std::string> checksums;
  for (const std::string& file : files) {
    const std::string bytes = read_text_file(file, std::size_t{1} << 32);
    checksums[fs::path(file).filename().string()] =
        fmt::format("{:08x}, {} bytes", crc32c(std::as_bytes(std::span(bytes))), bytes.size());
  }
  return checksums;
}

void warn_of_other_modules(const std::map<std::string, std::string>& trained, const std::vector<std::string>& files,
                           Diagnostics& diagnostics) {
  for (const auto& [name, checksum] : module_checksums(files)) {
    const auto before = trained.find(name);
    if (before == trained.end() || before->second == checksum) continue;
    diagnostics.warning("plugin.module.changed", name,
                        fmt::format("the file of this plugin is not the one that the run was trained with: its "
                                    "CRC-32C is {} where it was {}; results may differ",
                                    checksum, before->second),
                        "load the file that it was trained with, or train again");
  }
}

}  // namespace semfield
