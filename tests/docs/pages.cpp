// Reading pages.
#include "tests/docs/pages.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <sstream>

namespace semfield::docs {

namespace fs = std::filesystem;

std::string page(const std::string& path) {
  std::ifstream file(fs::path(SEMFIELD_SOURCE_DIR) / path, std::ios::binary);
  if (!file.good()) file.open(fs::path(SEMFIELD_BINARY_DIR) / "docs" / path, std::ios::binary);
  EXPECT_TRUE(file.good()) << path << " cannot be read";
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

std::vector<std::string> all_pages() {
  const fs::path root = SEMFIELD_SOURCE_DIR;
  std::vector<std::string> pages;
  for (const auto& entry : fs::directory_iterator(root)) {
    if (entry.path().extension() == ".md") pages.push_back(entry.path().filename().string());
  }
  for (const char* folder : {"docs", "plugins", "scenes", "tests", "studies"}) {
    for (const auto& entry : fs::recursive_directory_iterator(root / folder)) {
      if (entry.path().extension() == ".md") pages.push_back(fs::relative(entry.path(), root).generic_string());
    }
  }
  std::sort(pages.begin(), pages.end());
  return pages;
}

std::vector<Block> blocks_of(const std::string& text) {
  std::vector<Block> blocks;
  std::istringstream lines(text);
  bool inside = false;
  for (std::string line; std::getline(lines, line);) {
    if (line.rfind("```", 0) == 0) {
      if (!inside) blocks.push_back({line.substr(3), ""});
      inside = !inside;
    } else if (inside) {
      blocks.back().text += line + "\n";
    }
  }
  EXPECT_FALSE(inside) << "a fenced block has no end";
  return blocks;
}

}  // namespace semfield::docs
