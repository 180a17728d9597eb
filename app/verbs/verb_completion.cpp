// completion: the script that lets a shell complete the program's words.
#include <cstdio>

#include "app/command_line/completion.h"
#include "app/verb.h"

namespace semfield::app {

namespace {

struct CompletionOptions {
  std::string shell;
};

int run(const CompletionOptions& options, AppContext&) {
  std::fputs(completion_script(options.shell).c_str(), stdout);
  return 0;
}

void words(VerbWords& verb, CompletionOptions& options) {
  verb.operand("shell", options.shell, "bash, zsh or fish", shells());
}

}  // namespace

Verb verb_completion() {
  return make_verb<CompletionOptions>("completion", 220, "print a script that completes verbs and options in a shell",
                                      words, run);
}

}  // namespace semfield::app
