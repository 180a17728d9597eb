// Manual pages of the program and of its verbs, in the macros of man(7).
#pragma once

#include <string>

#include "app/command_line/grammar.h"

namespace semfield::app {

/// The page of a verb or group; of the program for nullptr.
std::string man_page(const Grammar& grammar, const VerbGrammar* verb);
/// "semfield-config-check.1"; "semfield.1" for nullptr.
std::string man_file(const VerbGrammar* verb);

/// docs/reference/verbs.md: every verb with its operands and options.
std::string verbs_page(const Grammar& grammar);

}  // namespace semfield::app
