// What pages point at exists: citations, folders, verbs and their options, exit codes; configurations are read.
// `scripts/docs_check` looks at links and words.
#include "tests/docs/pages.h"

#include <algorithm>
#include <array>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <memory>
#include <regex>
#include <set>

#include "plugin/loader.h"
#include "session/settings/run_config.h"
#include "system/files.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

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

// What `pattern` captures in the texts of the tree, with one file each that has it.
std::map<std::string, std::string> found_in_tree(const std::string& pattern) {
  std::map<std::string, std::string> found;
  const fs::path root = SEMFIELD_SOURCE_DIR;
  const std::set<std::string> endings{".h", ".cpp", ".cu", ".py", ".md", ".yaml", ".cmake", ".txt", ""};
  for (const char* folder :
       {"framework", "plugins", "app", "tests", "studies", "scripts", "configs", "docs", "cmake", "scenes", "."}) {
    const bool top = std::string(folder) == ".";
    for (auto it = fs::recursive_directory_iterator(root / folder); it != fs::recursive_directory_iterator(); ++it) {
      if (top && it->is_directory()) it.disable_recursion_pending();
      if (!it->is_regular_file() || !endings.contains(it->path().extension().string())) continue;
      const std::string path = fs::relative(it->path(), root).generic_string();
      for (const std::string& text : matches(page(path), pattern)) found.emplace(text, path);
    }
  }
  return found;
}

TEST(References, EveryCitationResolvesAndEveryEntryIsCited) {
  const std::set<std::string> entries = matches(page("docs/reference/references.bib"), R"(@[a-z]+\{([A-Za-z0-9]+),)");
  // Keys cited as [Zhi21], [Zhi21 Eq. 3] or [Zhi21, Sec. 2].
  const std::map<std::string, std::string> cited = found_in_tree(R"(\[([A-Z][A-Za-z]{2,}[0-9]{1,4})(?=[\],; :]))");
  EXPECT_GE(cited.size(), 12u);
  for (const auto& [key, path] : cited)
    EXPECT_TRUE(entries.contains(key)) << path << " cites [" << key << "], which docs/reference/references.bib lacks";
  for (const std::string& key : entries) EXPECT_TRUE(cited.contains(key)) << "nothing cites [" << key << "]";
}

// What sources, configurations, scripts and messages call docs/... is there.
TEST(Pages, SourcesNameDocumentsThatExist) {
  const fs::path root = SEMFIELD_SOURCE_DIR;
  int named = 0;
  for (const auto& [name, path] : found_in_tree(R"((?:^|[^A-Za-z0-9_/.-])(docs/[A-Za-z0-9_/.-]*[A-Za-z0-9_]))")) {
    ++named;
    const bool there = fs::exists(root / name) || fs::exists(fs::path(SEMFIELD_BINARY_DIR) / "docs" / name);
    EXPECT_TRUE(there) << path << " names " << name;
  }
  EXPECT_GE(named, 15);
}

TEST(Architecture, EveryFolderOfTheFrameworkHasItsPlace) {
  const std::string text = page("ARCHITECTURE.md");
  int folders = 0;
  for (const auto& entry : fs::directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / "framework")) {
    if (!entry.is_directory()) continue;
    ++folders;
    const std::string name = entry.path().filename().string();
    EXPECT_HAS(text, "\n  " + name + "/ ") << "the tree lacks framework/" << name;
    EXPECT_HAS(text, "\n| `" + name + "` |") << "the table of floors lacks " << name;
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
  const std::size_t list = help.find("\nVerbs:");
  if (list == std::string::npos) return help;
  for (const std::string& word : matches(help.substr(list), R"(\n  ([a-z-]+) )"))
    help += output_of(verb + " " + word + " --help");
  return help;
}

// The built pages have every plugin's table and no mark where one belongs.
TEST(BuiltPages, TablesArePutWhereAPageHasTheirMark) {
  const fs::path built = fs::path(SEMFIELD_BINARY_DIR) / "docs";
  EXPECT_HAS(page("docs/reference/plugins.md"), "### `hash_grid`");
  EXPECT_HAS(read_text_file((built / "plugins/encoders/hash_grid/README.md").string()), "| `levels` | int |");
  EXPECT_HAS(read_text_file((built / "docs/reference/configuration.md").string()), "### `train`");
  int marked = 0;
  for (const std::string& path : all_pages()) {
    const std::regex mark("\n<!-- (parameters|sections|table [^>]*|sources) -->\n");
    if (!std::regex_search(page(path), mark)) continue;
    ++marked;
    EXPECT_FALSE(std::regex_search(read_text_file((built / path).string()), mark)) << path;
  }
  EXPECT_GE(marked, 20);
}

// Every app/verbs/**/verb_NAME.cpp by its file, "config_check", and every verb and group of the help written that way.
TEST(CommandLine, EveryVerbFileIsAVerbAndEveryVerbHasItsFile) {
  std::set<std::string> files, verbs;
  for (const auto& entry : fs::recursive_directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / "app")) {
    const std::string name = entry.path().filename().string();
    if (!name.starts_with("verb_") || !name.ends_with(".cpp")) continue;
    std::ifstream file(entry.path());
    const std::string source{std::istreambuf_iterator<char>(file), {}};
    files.merge(matches(source, R"(\nVerb verb_(\w+)\(\) \{)"));
  }
  const auto words_of = [](const std::string& help) {
    const std::size_t list = help.find("\nVerbs:");
    return list == std::string::npos ? std::set<std::string>() : matches(help.substr(list), R"(\n  ([a-z-]+) )");
  };
  const auto file_of = [](std::string verb) {
    std::replace(verb.begin(), verb.end(), '-', '_');
    return verb;
  };
  for (const std::string& verb : words_of(output_of("--help"))) {
    verbs.insert(file_of(verb));
    for (const std::string& word : words_of(output_of(verb + " --help"))) verbs.insert(file_of(verb + "_" + word));
  }
  EXPECT_EQ(verbs, files);
}

// A verb, option or operand without a sentence leaves its line of the help with blanks at the end.
TEST(CommandLine, EveryVerbAndOptionHasASentence) {
  const std::string help = output_of("--help");
  const std::set<std::string> verbs = matches(help.substr(help.find("\nVerbs:")), R"(\n  ([a-z-]+) )");
  EXPECT_GE(verbs.size(), 15u);
  for (const std::string& verb : verbs) {
    for (const std::string& line : matches(help_of(verb), R"(\n(  \S[^\n]*) (?=\n))"))
      ADD_FAILURE() << verb << ": " << line;
  }
}

TEST(CommandLinePage, ExitCodesAreThoseOfTheProgram) {
  std::set<std::string> listed = matches(page("docs/reference/command_line.md"), R"(\n\| ([0-9]+)[, |])");
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
        if (verb.starts_with("-")) {
          EXPECT_HAS(root_help, verb) << path << ": " << line;
          continue;
        }
        if (!help.contains(verb)) help[verb] = help_of(verb) + root_help;
        EXPECT_HAS(help[verb], "Usage: semfield " + verb) << path << ": " << line;
        for (const std::string& option : matches(line, R"((--[a-z][a-z-]*))")) {
          ++checked;
          EXPECT_HAS(help[verb], option + " ") << path << ": " << line;
        }
      }
    }
  }
  EXPECT_GE(checked, 5);
}

// A block marked `yaml` is a whole configuration, saved in configs/ as it or the text around it says.
TEST(Pages, EveryYamlBlockIsRead) {
  const TempDir folder;
  const fs::path configs = fs::path(SEMFIELD_SOURCE_DIR) / "configs";
  for (const auto& entry : fs::recursive_directory_iterator(configs)) {  // by content: the originals may be read-only
    if (!entry.is_regular_file()) continue;
    folder.write(fs::relative(entry.path(), configs).string(), read_text_file(entry.path().string()));
  }
  Registry registry;
  register_linked_plugins(registry);
  int read = 0;
  for (const std::string& path : all_pages()) {
    for (const Block& block : blocks_of(page(path))) {
      if (block.info != "yaml" && !block.info.starts_with("yaml file=configs/")) continue;
      const std::string file = folder.write("block.yaml", block.text);
      try {
        load_run_config(file, {}, registry);
        ++read;
      } catch (const Error& error) {
        ADD_FAILURE() << path << ":\n" << block.text << error.what();
      }
    }
  }
  EXPECT_GE(read, 4);
}

}  // namespace
}  // namespace semfield::docs
