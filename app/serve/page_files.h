// The page's own files, read once: what is not in the list is not there.
#pragma once

#include <map>
#include <string>

namespace semfield::app {

struct PageFile {
  std::string type;  ///< MIME
  std::string bytes;
};

/// Files of `folder` by name: scripts, styles, pages and pictures; "" is index.html. Throws Error(no_input) where the
/// folder or its index.html is missing.
std::map<std::string, PageFile> read_page_files(const std::string& folder);

}  // namespace semfield::app
