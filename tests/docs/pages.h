// The project's documents as text: pages, fenced blocks, parts between markers.
#pragma once

#include <string>
#include <vector>

namespace semfield::docs {

/// Whole file under the project's folder; "" and a test failure when it cannot be read.
std::string page(const std::string& path);

/// Paths of every committed page: *.md at the top, under docs/, plugins/, scenes/, tests/ and studies/.
std::vector<std::string> all_pages();

struct Block {
  std::string info;  ///< what stands behind the opening fence: "yaml", "cpp file=a.cpp"
  std::string text;
};
std::vector<Block> blocks_of(const std::string& text);

/// `text` with everything between the markers replaced; both markers must be there once.
std::string with_part(const std::string& text, const std::string& begin, const std::string& end,
                      const std::string& part);

}  // namespace semfield::docs
