// The project's documents as text: pages and fenced blocks.
#pragma once

#include <string>
#include <vector>

namespace semfield::docs {

/// Whole file under the project's folder, or a page that only the build writes; "" and a test failure when there is none.
std::string page(const std::string& path);

/// Paths of every page of the tree: *.md at the top, under docs/, plugins/, scenes/, tests/ and studies/.
std::vector<std::string> all_pages();

struct Block {
  std::string info;  ///< what stands behind the opening fence: "yaml", "cpp file=a.cpp"
  std::string text;
};
std::vector<Block> blocks_of(const std::string& text);

}  // namespace semfield::docs
