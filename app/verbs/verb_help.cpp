// help: the words of the program, of a group or of a verb, on the terminal or as pages.
#include <cstdio>
#include <filesystem>

#include "app/command_line/help.h"
#include "app/verb.h"
#include "core/error.h"
#include "plugin/reference.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

struct HelpOptions {
  std::vector<std::string> verb;
  bool man = false;
  std::string out;    ///< folder of all manual pages; "": one page to stdout
  std::string pages;  ///< source tree whose generated pages are renewed
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

// plugins.md and verbs.md in docs/reference, and the table of parameters in each plugin folder's README.
void renew_pages(const Grammar& grammar, const fs::path& root, const AppContext& context) {
  if (!fs::is_directory(root / "plugins"))
    throw Error(ErrorKind::no_input, "files.folder.missing", "--pages " + root.string() + ": it has no folder plugins",
                "name a source tree");
  int written = 0;
  const auto write_if_new = [&written](const fs::path& path, const std::string& text) {
    if (fs::exists(path) && read_text_file(path.string()) == text) return;
    write_file_atomic(path.string(), text);
    ++written;
  };
  fs::create_directories(root / "docs" / "reference");
  write_if_new(root / "docs" / "reference" / "plugins.md", plugins_markdown(context.registry));
  write_if_new(root / "docs" / "reference" / "verbs.md", verbs_page(grammar));
  for (const PluginEntry* entry : context.registry.entries()) {
    const fs::path own = fs::path(kind_folder(entry->kind)) / entry->name / "README.md";
    const fs::path readme = fs::exists(root / "framework" / own) ? root / "framework" / own : root / "plugins" / own;
    if (fs::exists(readme)) write_if_new(readme, with_parameter_table(read_text_file(readme.string()), *entry));
  }
  print_note(context, std::to_string(written) + " generated pages changed under " + root.string());
}

int run(const HelpOptions& options, AppContext& context) {
  const Grammar& grammar = program_grammar();
  const VerbGrammar* verb = verb_named(grammar, options.verb);
  if (verb != nullptr && !(options.out + options.pages).empty())
    throw Error(ErrorKind::usage, "usage.flag.conflict", "the pages of all verbs are written, and one is named",
                "leave out one of them");
  if (!options.pages.empty()) {
    renew_pages(grammar, options.pages, context);
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
  verb.value("--pages FOLDER", options.pages, "source tree whose generated pages about verbs and plugins are renewed");
  verb.needs("--out", "--man");
  verb.excludes("--pages", "--man");
}

}  // namespace

Verb verb_help() { return make_verb<HelpOptions>("help", 210, "print the usage of a verb", words, run); }

}  // namespace semfield::app
