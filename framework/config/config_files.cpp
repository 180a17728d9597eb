#include "config/config_files.h"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <vector>

#include "core/error.h"
#include "core/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr const char* kEnding = ".yaml";

bool is_no_folder(const fs::path& path) { return is_there(path) && !is_folder(path); }

// `path`, or with the ending that may be left out; "" when neither is there.
std::string with_ending(const fs::path& path) {
  if (is_no_folder(path)) return path.string();
  fs::path longer = path;
  longer += kEnding;
  return is_no_folder(longer) ? longer.string() : "";
}

// Names without the ending of configurations in the folder that `place`, a path that is not there, would lie in.
void add_neighbours(const fs::path& place, std::vector<std::string>& names) {
  std::error_code unknown;
  const fs::path folder = place.has_parent_path() ? place.parent_path() : fs::path(".");
  for (fs::directory_iterator it(folder, unknown), end; !unknown && it != end; it.increment(unknown)) {
    if (it->path().extension() == kEnding) names.push_back(it->path().stem().string());
  }
}

}  // namespace

std::string shipped_place(const std::string& name) {
  const fs::path written = fs::path(name).lexically_normal();
  const std::string root = shared_root();
  if (root.empty() || written.empty() || written.is_absolute()) return "";
  const bool whole = *written.begin() == "configs";
  return (whole ? fs::path(root) / written : fs::path(root) / "configs" / written).string();
}

std::string shipped_config(const std::string& name) {
  const std::string place = shipped_place(name);
  return place.empty() ? "" : with_ending(place);
}

std::string near_config(const std::string& name, const std::string& own_place) {
  const std::string place = shipped_place(name);
  std::vector<std::string> names;
  add_neighbours(own_place, names);
  if (!place.empty()) add_neighbours(place, names);
  std::sort(names.begin(), names.end());  // of two that are equally near, the same one on every file system
  const fs::path written(name);
  const std::string ending = written.extension() == kEnding ? kEnding : "";
  const std::string near = did_you_mean((ending.empty() ? written.filename() : written.stem()).string(), names);
  return near.empty() ? "" : (written.parent_path() / near).string() + ending;
}

std::string find_config(const std::string& name) {
  if (const std::string own = with_ending(name); !own.empty()) return own;
  if (std::string shipped = shipped_config(name); !shipped.empty()) return shipped;
  if (is_there(name)) return name;  // a folder, which the reader refuses by that name
  const std::string place = shipped_place(name), near = near_config(name, name);
  throw Error(ErrorKind::no_input, "config.file.missing",
              "no configuration '" + name + "'" +
                  (place.empty() ? std::string() : " (looked for '" + name + "' and '" + place + "')"),
              near.empty() ? "check the path" : "did you mean '" + near + "'?");
}

}  // namespace semfield
