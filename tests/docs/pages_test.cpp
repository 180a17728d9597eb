// What pages point at exists: citations, links, folders, verbs and their options, exit codes.
#include "tests/docs/pages.h"

#include <gtest/gtest.h>

#include <array>
#include <cstdio>
#include <filesystem>
#include <map>
#include <memory>
#include <regex>
#include <set>

#include "core/words.h"

namespace semfield::docs {
namespace {

namespace fs = std::filesystem;

std::set<std::string> matches(const std::string& text, const std::string& pattern) {
  std::set<std::string> found;
  const std::regex regex(pattern);
  for (auto it = std::sregex_iterator(text.begin(), text.end(), regex); it != std::sregex_iterator(); ++it)
    found.insert((*it)[1]);
  return found;
}

// Keys cited as [Name07], [Name07 Eq. 3] or [Name07, Sec. 2], with the files that do.
std::map<std::string, std::string> cited_keys() {
  std::map<std::string, std::string> cited;
  const fs::path root = SEMFIELD_SOURCE_DIR;
  const std::set<std::string> endings{".h", ".cpp", ".cu", ".py", ".md", ".yaml", ".cmake", ".txt"};
  for (const char* folder : {"framework", "plugins", "app", "tests", "bench", "scripts", "configs", "docs", "."}) {
    const bool top = std::string(folder) == ".";
    for (auto it = fs::recursive_directory_iterator(root / folder); it != fs::recursive_directory_iterator(); ++it) {
      if (top && it->is_directory()) it.disable_recursion_pending();
      if (!it->is_regular_file() || !endings.contains(it->path().extension().string())) continue;
      const std::string path = fs::relative(it->path(), root).generic_string();
      for (const std::string& key : matches(page(path), R"(\[([A-Z][A-Za-z]{2,}[0-9]{1,4})(?=[\],; :]))"))
        cited.emplace(key, path);
    }
  }
  return cited;
}

TEST(References, EveryCitationResolvesAndEveryEntryIsCited) {
  const std::set<std::string> entries = matches(page("docs/references.bib"), R"(@[a-z]+\{([A-Za-z0-9]+),)");
  std::map<std::string, std::string> cited = cited_keys();
  cited.erase("Name07");  // this file's own example
  EXPECT_GE(cited.size(), 12u);
  for (const auto& [key, path] : cited)
    EXPECT_TRUE(entries.contains(key)) << path << " cites [" << key << "], which docs/references.bib lacks";
  for (const std::string& key : entries) EXPECT_TRUE(cited.contains(key)) << "nothing cites [" << key << "]";
}

TEST(Pages, LinksPointAtFiles) {
  int checked = 0;
  for (const std::string& path : all_pages()) {
    for (const std::string& target : matches(page(path), R"(\]\(([^)#\s]+)[^)]*\))")) {
      if (target.find("://") != std::string::npos || target.rfind("docs/images/", 0) == 0) continue;
      ++checked;
      const fs::path file = (fs::path(SEMFIELD_SOURCE_DIR) / path).parent_path() / target;
      EXPECT_TRUE(fs::exists(file)) << path << " links to " << target;
    }
  }
  EXPECT_GE(checked, 10);
}

TEST(Pages, PicturesAreThere) {
  const fs::path folder = fs::path(SEMFIELD_SOURCE_DIR) / "docs/images";
  if (!fs::exists(folder)) GTEST_SKIP() << "this tree has no docs/images: no picture was made yet";
  for (const std::string& target : matches(page("README.md"), R"(\]\((docs/images/[^)]+)\))"))
    EXPECT_TRUE(fs::exists(fs::path(SEMFIELD_SOURCE_DIR) / target)) << "README.md shows " << target;
}

TEST(Architecture, EveryFolderOfTheFrameworkHasItsPlace) {
  const std::string text = page("ARCHITECTURE.md");
  int folders = 0;
  for (const auto& entry : fs::directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / "framework")) {
    if (!entry.is_directory()) continue;
    ++folders;
    const std::string name = entry.path().filename().string();
    EXPECT_NE(text.find("\n  " + name + "/ "), std::string::npos) << "the tree lacks framework/" << name;
    EXPECT_NE(text.find("\n| `" + name + "` |"), std::string::npos) << "the table of floors lacks " << name;
  }
  EXPECT_GE(folders, 8);
}

// What the program prints for `words`.
std::string output_of(const std::string& words) {
  const std::string command = shell_word(SEMFIELD_PROGRAM) + " " + words;
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(popen(command.c_str(), "r"), pclose);
  std::string text;
  std::array<char, 4096> buffer{};
  while (pipe && fgets(buffer.data(), static_cast<int>(buffer.size()), pipe.get()) != nullptr) text += buffer.data();
  return text;
}

// Help of a verb and of the words below it.
std::string help_of(const std::string& verb) {
  std::string help = output_of(verb + " --help");
  const std::size_t list = help.find("Subcommands:");
  if (list == std::string::npos) return help;
  for (const std::string& word : matches(help.substr(list), R"(\n  ([a-z-]+) )"))
    help += output_of(verb + " " + word + " --help");
  return help;
}

TEST(Readme, TableOfVerbsIsThatOfTheProgram) {
  const std::string help = output_of("--help");
  const std::size_t list = help.find("Subcommands:");
  ASSERT_NE(list, std::string::npos) << help;
  const std::set<std::string> have = matches(help.substr(list), R"(\n  ([a-z-]+) )");
  const std::string readme = page("README.md");
  const std::size_t begin = readme.find("## Verbs");
  ASSERT_NE(begin, std::string::npos);
  const std::string section = readme.substr(begin, readme.find("\n## ", begin + 1) - begin);
  EXPECT_EQ(matches(section, R"(\n\| `([a-z-]+)[ `])"), have);
  for (const std::string& verb : have) {
    const std::string options = help_of(verb) + help;
    const std::set<std::string> rows = matches(section, "(\n\\| `" + verb + "[ `][^\n]*)");
    ASSERT_EQ(rows.size(), 1u) << verb;
    for (const std::string& option : matches(*rows.begin(), R"((--[a-z][a-z-]*))"))
      EXPECT_NE(options.find(option), std::string::npos) << "`semfield " << verb << "` has no " << option;
  }
}

TEST(Readme, ExitCodesAreThoseOfTheProgram) {
  const std::string readme = page("README.md");
  std::set<std::string> listed = matches(readme, R"(\n\| ([0-9]+)[, |])");
  std::set<std::string> have = matches(page("framework/core/error.h"), R"(\n  [a-z_]+ = ([0-9]+),)");
  have.insert({"0", "130"});
  EXPECT_EQ(listed, have);
}

// Every command line in a shell block of a page names a verb and options that exist.
TEST(Pages, ShellBlocksUseRealOptions) {
  std::map<std::string, std::string> help;
  const std::string root_help = output_of("--help");
  int checked = 0;
  for (const std::string& path : all_pages()) {
    for (const Block& block : blocks_of(page(path))) {
      if (block.info != "sh") continue;
      for (const std::string& line : matches("\n" + block.text, "\n(semfield [^\n#]*)")) {
        const std::string verb = *matches(line, "^semfield ([a-z-]+)").begin();
        if (!help.contains(verb)) help[verb] = help_of(verb) + root_help;
        EXPECT_NE(help[verb].find("Usage: semfield " + verb), std::string::npos) << path << ": " << line;
        for (const std::string& option : matches(line, R"((--[a-z][a-z-]*))")) {
          ++checked;
          EXPECT_NE(help[verb].find(option + " "), std::string::npos) << path << ": " << line;
        }
      }
    }
  }
  EXPECT_GE(checked, 5);
}

}  // namespace
}  // namespace semfield::docs
