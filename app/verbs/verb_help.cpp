// help: the words of the program, of a group or of a verb.
#include <cstdio>

#include "app/command_line/grammar.h"
#include "app/command_line/help.h"
#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

struct HelpOptions {
  std::vector<std::string> verb;
};

int run(const HelpOptions& options, AppContext&) {
  const Grammar& grammar = program_grammar();
  const VerbGrammar* verb = verb_named(grammar, options.verb);
  std::fputs((verb == nullptr ? program_help(grammar) : verb_help(grammar, *verb)).c_str(), stdout);
  return 0;
}

void words(VerbWords& verb, HelpOptions& options) {
  verb.optional_operands("verb", options.verb, "verb, such as: train, config check (default: the list of all verbs)",
                         words_of_verbs());
}

}  // namespace

Verb verb_help() { return make_verb<HelpOptions>("help", 210, "print the words of a verb", words, run); }

}  // namespace semfield::app
