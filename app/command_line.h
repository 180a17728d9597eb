// Words to verbs: the only user of CLI11, which parses them and prints their help.
#pragma once

#include <string>
#include <vector>

#include "app/app_context.h"

namespace semfield::app {

/// Parses and runs; returns the exit code. Throws Error(usage) for words that no verb takes. As one of several
/// processes of a launcher it runs a verb as its `launch` says, and refuses ranks that were started with different
/// words: rank 0's alone would count.
int run_command_line(int argc, char** argv, AppContext& context);

/// Whether this process prints what went wrong before it has joined the others: rank 0 does, and who is alone.
bool is_first_process();

/// What `semfield VERB --help` prints; of the program where `verb` is empty. Throws Error(usage) for what is no verb.
std::string help_of(const std::vector<std::string>& verb);
/// docs/reference/verbs.md: the help of every verb.
std::string verbs_page();

}  // namespace semfield::app
