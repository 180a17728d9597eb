// What the words of a command line may go on with, for shells that complete them.
#pragma once

#include <string>
#include <vector>

#include "app/command_line/command_line.h"

namespace semfield::app {

/// "bash", "zsh", "fish".
const std::vector<std::string>& shells();
/// The script that a shell of shells() reads. It runs the program at each TAB: `semfield completion --of WORDS`.
std::string completion_script(const std::string& shell);

/// What the last of `words`, which may be empty, may become; the others stand before it. The first line is "words",
/// "files", "folders" (of which the shell offers its own, beside the candidates) or "list" (more may follow without a
/// blank); then a line for each candidate: it, a tab and a sentence. A word "=" alone stands between an option and its
/// value, as bash cuts them.
std::string completions(const Grammar& grammar, const std::vector<std::string>& words);

}  // namespace semfield::app
