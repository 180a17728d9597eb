// What a verb says that people do next: commands that work as they stand, in the order printed.
#pragma once

#include <string>
#include <vector>

#include "app/app_context.h"

namespace semfield::app {

struct NextStep {
  std::string words;  ///< behind the program's name
  std::string what;   ///< what it does, for people
};

/// On stderr, a line each, which no terminal's width breaks: they are copied. Nothing for --quiet, --json, and for
/// verbs that `semfield demo` runs.
void print_next(const AppContext& context, const std::vector<NextStep>& steps);

/// For verbs that start others, which say what is next themselves.
void leave_next_out_of_children();

}  // namespace semfield::app
