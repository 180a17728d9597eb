// help: the words of the program, of a group or of a verb, on the terminal or as pages.
#include <cstdio>
#include <filesystem>

#include "app/command_line/help.h"
#include "app/verb.h"
#include "core/error.h"
#include "plugin/reference.h"
#include "session/settings/run_config.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

struct HelpOptions {
  std::vector<std::string> verb;
  bool man = false;
  std::string out;    ///< folder of all manual pages; "": one page to stdout
  std::string pages;  ///< copy of the tree's pages, in which those about the program are written
};

void write_man_pages(const Grammar& grammar, const std::string& folder, const AppContext& context) {
  create_folders(folder);
  const auto write = [&](const VerbGrammar* verb) {
    write_file_atomic((fs::path(folder) / man_file(verb)).string(), man_page(grammar, verb));
  };
  write(nullptr);
  for (const VerbGrammar& verb : grammar.verbs) write(&verb);
  print_note(context, std::to_string(grammar.verbs.size() + 1) + " manual pages written to " + folder);
}

// Tables of every section of a configuration, under headings of their own.
std::string section_tables() {
  std::string text;
  for (const SectionDoc& section : describe_sections())
    text +=
        "### `" + section.path + "`: " + section.sentence + "\n\n" + parameter_table_markdown(section.params) + "\n";
  return text;
}

// Pages of the program's own words: verbs and plugins whole, and tables where a page has their mark.
void write_pages(const Grammar& grammar, const fs::path& root, const AppContext& context) {
  if (!fs::is_directory(root / "plugins"))
    throw Error(ErrorKind::no_input, "files.folder.missing", "--pages " + root.string() + ": it has no folder plugins",
                "name a copy of the pages of the source tree");
  const fs::path reference = root / "docs" / "reference";
  fs::create_directories(reference);
  write_file_atomic((reference / "plugins.md").string(), plugins_markdown(context.registry));
  write_file_atomic((reference / "verbs.md").string(), verbs_page(grammar));
  int filled = 0;
  const auto fill = [&filled](const fs::path& path, const std::string& mark, const std::string& part) {
    std::string text = fs::exists(path) ? read_text_file(path.string()) : "";
    const std::size_t at = text.find(mark);
    if (at == std::string::npos) return;
    write_file_atomic(path.string(), text.replace(at, mark.size(), part));
    ++filled;
  };
  fill(reference / "configuration.md", "<!-- sections -->\n", section_tables());
  for (const PluginEntry* entry : context.registry.entries()) {
    for (const char* tree : {"framework", "plugins"})
      fill(root / tree / kind_folder(entry->kind) / entry->name / "README.md", "<!-- parameters -->\n",
           parameter_table_markdown(*entry));
  }
  print_note(context,
             "verbs.md and plugins.md written, " + std::to_string(filled) + " tables filled under " + root.string());
}

int run(const HelpOptions& options, AppContext& context) {
  const Grammar& grammar = program_grammar();
  const VerbGrammar* verb = verb_named(grammar, options.verb);
  if (verb != nullptr && !(options.out + options.pages).empty())
    throw Error(ErrorKind::usage, "usage.flag.conflict", "the pages of all verbs are written, and one is named",
                "leave out one of them");
  if (!options.pages.empty()) {
    write_pages(grammar, options.pages, context);
  } else if (!options.out.empty()) {
    write_man_pages(grammar, options.out, context);
  } else {
    const std::string text = options.man       ? man_page(grammar, verb)
                             : verb == nullptr ? program_help(grammar)
                                               : verb_help(grammar, *verb);
    std::fputs(text.c_str(), stdout);
  }
  return 0;
}

void words(VerbWords& verb, HelpOptions& options) {
  verb.optional_operands("verb", options.verb, "verb, such as: train, config check (default: the list of all verbs)",
                         words_of_verbs());
  verb.flag("--man", options.man, "print a manual page, for man(1)");
  verb.value("--out FOLDER", options.out, "write the manual pages of the program and all verbs to this folder");
  verb.value("--pages FOLDER", options.pages,
             "copy of the pages of the source tree, in which those about verbs, plugins and keys are written");
  verb.needs("--out", "--man");
  verb.excludes("--pages", "--man");
}

}  // namespace

Verb verb_help() { return make_verb<HelpOptions>("help", 210, "print the usage of a verb", words, run); }

}  // namespace semfield::app
