// What the verbs of this folder print of plugins.
#pragma once

#include <string>

#include "app/app_context.h"

namespace semfield::app {

/// To stdout, byte for byte.
void print_text(const std::string& text);
/// As JSON: every plugin, or the one of this name.
void print_plugins_json(const AppContext& context, const std::string& only = {});
/// What this build has for CUDA, into the registry's tables; no device is needed for that. Generated pages do without
/// it: they are the same for every build.
void add_cuda_kernels(AppContext& context);

}  // namespace semfield::app
