// The floors of the house: which file may include what.
#pragma once

#include <string>
#include <vector>

namespace semfield::architecture {

struct SourceFile {
  std::string path;  ///< relative to the project, with '/'
  std::string text;
};

/// Every file under the project's `folder` whose name ends in one of `endings`, by path.
std::vector<SourceFile> files_under(const std::string& folder, const std::vector<std::string>& endings);

struct Include {
  int line = 0;
  std::string target;  ///< between quotes or angle brackets
};
std::vector<Include> includes_of(const std::string& text);

/// "" when the file at `path` may include `target`, else the rule that forbids it.
std::string why_forbidden(const std::string& path, const std::string& target);

}  // namespace semfield::architecture
