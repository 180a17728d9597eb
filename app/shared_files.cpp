#include "app/shared_files.h"

#include <filesystem>

#include "core/error.h"

namespace semfield::app {

std::string shared_file(const std::string& relative) {
  namespace fs = std::filesystem;
  std::error_code unknown;
  const fs::path program = fs::read_symlink("/proc/self/exe", unknown);
  const fs::path path = (program.parent_path().parent_path() / "share" / "semfield" / relative).lexically_normal();
  if (!fs::exists(path, unknown)) {
    throw Error(ErrorKind::no_input, "no file '" + path.string() + "', which comes with the program",
                "install the component 'app' whole, or run the program from its build folder");
  }
  return path.string();
}

}  // namespace semfield::app
