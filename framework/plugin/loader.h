// Linked and loaded modules into a registry.
#pragma once

#include <string>
#include <vector>

#include "plugin/module.h"

namespace semfield {

/// Checks API number and ABI tag, then runs the module's register function; a throwing one is wrapped with the module's
/// name.
void register_module(Registry& registry, const PluginModule& module);

/// dlopen(RTLD_NOW | RTLD_LOCAL) + register_module; never unloaded. What was asked for by path must load: throws
/// Error(unavailable) with a sentence that names both sides (missing file, missing symbol, other API, other ABI,
/// throwing registration, duplicate name).
void load_module(Registry& registry, const std::string& path);

}  // namespace semfield
