#include "system/shared_library.h"

#include <dlfcn.h>

#include <filesystem>

#include "core/error.h"

namespace semfield {

void* library_symbol(const std::string& file, const char* symbol, const std::string& what, const std::string& remedy) {
  Dl_info self{};
  ::dladdr(reinterpret_cast<const void*>(&library_symbol), &self);
  const std::filesystem::path folder =
      self.dli_fname != nullptr ? std::filesystem::path(self.dli_fname).parent_path() : std::filesystem::path();
  void* library = ::dlopen((folder / file).c_str(), RTLD_NOW | RTLD_LOCAL);
  void* found = library != nullptr ? ::dlsym(library, symbol) : nullptr;
  if (found == nullptr)
    throw Error(ErrorKind::unavailable, "system.library.missing", what + ": " + ::dlerror(), remedy);
  return found;
}

void* part_symbol(const std::string& target, const char* symbol, const std::string& what) {
  return library_symbol("lib" + target + ".so", symbol, what,
                        "build it (cmake --build FOLDER --target " + target + "), or install the whole of Semfield");
}

}  // namespace semfield
