// What this binary is, in sentences.
#pragma once

#include <string>

namespace semfield::app {

/// Version, compiler, plugin interface, processor and instruction sets, a line each.
std::string version_lines();
/// The same in one line.
std::string version_line();

}  // namespace semfield::app
