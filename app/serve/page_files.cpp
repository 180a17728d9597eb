#include "app/serve/page_files.h"

#include <filesystem>

#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

std::map<std::string, PageFile> read_page_files(const std::string& folder) {
  static const std::map<std::string, std::string> types{{".html", "text/html; charset=utf-8"},
                                                        {".js", "text/javascript; charset=utf-8"},
                                                        {".css", "text/css; charset=utf-8"},
                                                        {".svg", "image/svg+xml"},
                                                        {".png", "image/png"},
                                                        {".ico", "image/x-icon"}};
  std::map<std::string, PageFile> files;
  std::error_code failed;
  for (const auto& entry : std::filesystem::directory_iterator(folder, failed)) {
    const auto type = types.find(entry.path().extension().string());
    if (type == types.end() || !entry.is_regular_file(failed)) continue;
    files[entry.path().filename().string()] = {type->second, read_text_file(entry.path().string())};
  }
  const auto index = files.find("index.html");
  if (index == files.end())
    throw Error(ErrorKind::no_input, "files.shared.missing",
                folder + ": the page's index.html is not there, which comes with the program",
                "install the component 'app' whole, or run the program from its build folder");
  files[""] = index->second;
  return files;
}

}  // namespace semfield::app
