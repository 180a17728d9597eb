// What a plugin module exports, linked or loaded: one descriptor.
#pragma once

#include "plugin/registry.h"

namespace semfield {

/// Raised whenever an interface in plugin/ changes.
inline constexpr int kPluginApi = 1;

/// Compiler, standard library and layout facts that both sides must share ("gcc12-cxx11abi1-..."). Inline on purpose: a plugin's
/// copy is compiled with the plugin's flags.
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

/// Last line of a plugin. Linked build: a function semfield_module_<name>() that the generated table calls. Loadable build
/// (SEMFIELD_LOADABLE_MODULE defined): the one exported symbol semfield_plugin_module.
#ifdef SEMFIELD_LOADABLE_MODULE
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, register_function)                              \
  extern "C" __attribute__((visibility("default"))) const ::semfield::PluginModule semfield_plugin_module = { \
      ::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, module_version, register_function};
#else
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, register_function)                       \
  const ::semfield::PluginModule& semfield_module_##module_name() {                                  \
    static const ::semfield::PluginModule module{::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, \
                                                 module_version, register_function};                \
    return module;                                                                                   \
  }
#endif
