// A file that calls the standard library includes the header, or includes one of ours that does: which headers bring
// others along differs from library to library, and from version to version.
#include <gtest/gtest.h>

#include <filesystem>
#include <map>
#include <set>

#include "tests/architecture/include_rules.h"

namespace semfield::architecture {
namespace {

using Files = std::map<std::string, std::string>;  // text by path

const std::map<std::string, std::vector<std::string>>& calls_of_headers() {
  static const std::map<std::string, std::vector<std::string>> table{
      {"algorithm",
       {"sort(",           "stable_sort(", "nth_element(",   "partial_sort(", "any_of(",       "all_of(",
        "none_of(",        "find_if(",     "count(",         "count_if(",     "clamp(",        "reverse(",
        "unique(",         "remove_if(",   "lower_bound(",   "upper_bound(",  "max_element(",  "min_element(",
        "minmax_element(", "transform(",   "rotate(",        "equal(",        "fill(",         "fill_n(",
        "copy(",           "copy_n(",      "binary_search(", "is_sorted(",    "ranges::sort(", "max({",
        "min({",           "find("}},
      {"numeric", {"accumulate(", "iota(", "inner_product(", "partial_sum(", "midpoint(", "gcd("}},
      {"cmath",
       {"sqrt(", "exp(", "log(", "log2(", "pow(", "floor(", "ceil(", "lround(", "isfinite(", "isnan(", "fma("}},
      {"cstring", {"memcpy(", "memset(", "memcmp(", "memmove(", "strlen(", "strcmp(", "strerror("}},
      {"cstdlib", {"getenv(", "system(", "malloc(", "free(", "strtod(", "strtol(", "_Exit("}},
      {"cstdio", {"printf(", "fprintf(", "snprintf(", "fopen(", "fclose(", "fputs(", "rename("}},
      {"limits", {"numeric_limits<"}},
      {"functional", {"function<"}},
      {"memory", {"unique_ptr<", "shared_ptr<", "make_unique<", "make_shared<"}},
      {"atomic", {"atomic<"}},
      {"mutex", {"mutex ", "lock_guard<", "unique_lock<"}},
  };
  return table;
}

/// What a file includes, itself or through files of ours, with their paths.
void collect(const Files& files, const std::string& path, std::set<std::string>& included) {
  for (const Include& include : includes_of(files.at(path))) {
    bool ours = false;
    const std::string beside = std::filesystem::path(path).parent_path().string() + "/";
    for (const std::string& root : {beside, std::string("framework/"), std::string("plugins/"), std::string()}) {
      if (!files.contains(root + include.target)) continue;
      ours = true;
      if (included.insert(root + include.target).second) collect(files, root + include.target, included);
    }
    if (!ours) included.insert(include.target);
  }
}

TEST(StandardHeaders, AreIncludedByThoseWhoCallThem) {
  Files files;
  for (const char* folder : {"framework", "plugins", "app", "tests"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files[file.path] = std::move(file.text);
  }
  EXPECT_GT(files.size(), 300u);
  for (const auto& [path, text] : files) {
    std::set<std::string> included;
    collect(files, path, included);
    for (const auto& [header, calls] : calls_of_headers()) {
      if (included.contains(header)) continue;
      for (const std::string& call : calls) {
        if (text.find("std::" + call) != std::string::npos)
          ADD_FAILURE() << path << " has std::" << call << " and no #include <" << header << ">";
      }
    }
  }
}

}  // namespace
}  // namespace semfield::architecture
