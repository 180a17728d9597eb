// What a plugin module exports, linked or loaded: one descriptor.
#pragma once

#include "plugin/registry.h"

namespace semfield {

/// Raised whenever an interface in plugin/ changes.
inline constexpr int kPluginApi = 4;

/// The framework's own SEMFIELD_ABI_TAG, to be compared with the one that a module was compiled with.
const char* abi_tag_of_framework();

struct PluginModule {
  int api = 0;
  const char* abi_tag = "";
  const char* name = "";
  const char* version = "";
  void (*register_into)(Registry&) = nullptr;
};

}  // namespace semfield

#include "plugin/abi_tag.h"

/// Last line of a plugin. Linked build (inside namespace semfield): a function semfield_module_<name>() that the
/// generated table calls. Loadable build (SEMFIELD_LOADABLE_MODULE defined): the one exported symbol
/// semfield_plugin_module.
#ifdef SEMFIELD_LOADABLE_MODULE
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, register_function)                                     \
  extern "C" {                                                                                                     \
  __attribute__((visibility("default"))) extern const ::semfield::PluginModule semfield_plugin_module;             \
  const ::semfield::PluginModule semfield_plugin_module = {::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, \
                                                           module_version, register_function};                     \
  }
#else
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, register_function)                           \
  const ::semfield::PluginModule& semfield_module_##module_name() {                                      \
    static const ::semfield::PluginModule module{::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, \
                                                 module_version, register_function};                     \
    return module;                                                                                       \
  }
#endif
