// What this binary is.
#pragma once

#include <string>

namespace semfield::app {

/// Version, compiler, plugin interface, CPU and instruction sets, one line each.
std::string version_lines();

}  // namespace semfield::app
