// The table that CMake generates from plugins/*/*.
#pragma once

#include "plugin/registry.h"

namespace semfield {

/// Registers every plugin that this build links.
void register_linked_plugins(Registry& registry);

}  // namespace semfield
