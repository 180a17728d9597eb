#include "system/sorted_folder.h"

#include <algorithm>

#include "core/error.h"

namespace semfield {

namespace fs = std::filesystem;

std::vector<fs::directory_entry> sorted_folder(const std::string& folder) {
  std::vector<fs::directory_entry> entries;
  std::error_code error;
  for (fs::directory_iterator entry(folder, error), end; !error && entry != end; entry.increment(error))
    entries.push_back(*entry);
  if (error) {
    throw Error(ErrorKind::no_input, "files.folder.unreadable",
                "cannot read the folder '" + folder + "': " + error.message(),
                error == std::errc::permission_denied ? "check the permissions" : "check the path");
  }
  std::sort(entries.begin(), entries.end());
  return entries;
}

}  // namespace semfield
