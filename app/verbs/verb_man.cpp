// man: manual pages of the program and its verbs.
#include <cstdio>
#include <filesystem>

#include "app/command_line/help.h"
#include "app/command_line/man_page.h"
#include "app/verb.h"
#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ManOptions {
  std::vector<std::string> verb;
  std::string out;
};

int run(const ManOptions& options, AppContext& context) {
  const Grammar& grammar = program_grammar();
  if (options.out.empty()) {
    std::fputs(man_page(grammar, verb_named(grammar, options.verb)).c_str(), stdout);
    return 0;
  }
  if (!options.verb.empty())
    throw Error(ErrorKind::usage, "--out writes the pages of all verbs, and one is named", "leave out one of them");
  create_folders(options.out);
  const auto write = [&](const VerbGrammar* verb) {
    write_file_atomic((std::filesystem::path(options.out) / man_file(verb)).string(), man_page(grammar, verb));
  };
  write(nullptr);
  for (const VerbGrammar& verb : grammar.verbs) write(&verb);
  print_note(context, std::to_string(grammar.verbs.size() + 1) + " manual pages written to " + options.out);
  return 0;
}

void words(VerbWords& verb, ManOptions& options) {
  verb.optional_operands("verb", options.verb, "verb, such as: train, config check (default: the program itself)",
                         words_of_verbs());
  verb.value("--out FOLDER", options.out, "write the pages of the program and all verbs to this folder");
}

}  // namespace

Verb verb_man() { return make_verb<ManOptions>("man", 230, "print the manual page of a verb, for man(1)", words, run); }

}  // namespace semfield::app
