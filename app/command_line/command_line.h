// Words to verbs: the only user of CLI11.
#pragma once

#include "app/app_context.h"

namespace semfield::app {

/// Parses and runs; returns the exit code. Wrong usage prints what was expected and returns 2.
int run_command_line(int argc, char** argv, AppContext& context);

}  // namespace semfield::app
