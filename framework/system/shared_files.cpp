// Where shipped files lie, told by where the framework's library lies.
#include "system/shared_files.h"

#include <dlfcn.h>

#include <cstdlib>
#include <filesystem>

#include "core/error.h"

namespace semfield {

namespace fs = std::filesystem;

std::string shared_root() {
  std::error_code unknown;
  if (const char* named = std::getenv("SEMFIELD_SHARE"); named != nullptr && *named != '\0') {
    if (!fs::is_directory(named, unknown))
      throw Error(ErrorKind::config, "config.environment.value",
                  std::string("environment variable SEMFIELD_SHARE: no folder '") + named + "'",
                  "set it to the folder that holds configs/ and scenes/, or leave it out");
    return fs::absolute(named).lexically_normal().string();
  }
  Dl_info self{};
  if (::dladdr(reinterpret_cast<const void*>(&shared_root), &self) == 0 || self.dli_fname == nullptr) return "";
  // lib/, lib/semfield/ or lib/x86_64-linux-gnu/semfield/: libraries lie one to three folders below the prefix.
  fs::path folder = fs::weakly_canonical(self.dli_fname, unknown).parent_path();
  for (int level = 0; level < 3; ++level) {
    folder = folder.parent_path();
    const fs::path share = folder / "share" / "semfield";
    if (fs::is_directory(share / "configs", unknown)) return share.string();
  }
  return "";
}

std::string shared_file(const std::string& relative) {
  const std::string root = shared_root();
  const fs::path path = (fs::path(root) / relative).lexically_normal();
  std::error_code unknown;
  if (root.empty() || !fs::exists(path, unknown))
    throw Error(
        ErrorKind::no_input, "files.shared.missing",
        root.empty() ? "no file '" + relative + "', which comes with the program: no folder share/semfield"
                     : "no file '" + path.string() + "', which comes with the program",
        "install the component 'app' whole, or set SEMFIELD_SHARE to the folder that holds configs/ and scenes/");
  return path.string();
}

}  // namespace semfield
