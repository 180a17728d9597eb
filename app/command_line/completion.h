// Completion of the program's words in shells: a script for each, made from the grammar.
#pragma once

#include <string>
#include <vector>

#include "app/command_line/grammar.h"

namespace semfield::app {

/// "bash", "zsh", "fish".
const std::vector<std::string>& shells();
/// The script that a shell of shells() reads.
std::string completion_script(const Grammar& grammar, const std::string& shell);

std::string bash_completion(const Grammar& grammar);
std::string zsh_completion(const Grammar& grammar);
std::string fish_completion(const Grammar& grammar);

}  // namespace semfield::app
