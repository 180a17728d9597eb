// Files by the names that an index gives them: one that another system wrote may spell a path in another way.
#pragma once

#include <map>
#include <string>

namespace semfield {

/// Finds files under names of another system; each folder is listed once. For one thread.
class FileNames {
 public:
  /// The path of the file that `path` means: as it stands where that is there; else with slashes for Windows'
  /// backslashes; else with those parts that differ from the only name in their folder that looks the same by nothing
  /// but the form of its letters (core/unicode_forms.h). Where nothing is there: `path` with slashes.
  std::string of(const std::string& path);

 private:
  const std::string* looks_like(const std::string& folder, const std::string& name);

  std::map<std::string, std::map<std::string, std::string>> folders_;  // -> by decomposed name; "" for one of several
};

/// With slashes for backslashes.
std::string with_slashes(std::string path);

}  // namespace semfield
