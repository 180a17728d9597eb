// What a plugin module exports, linked or loaded: one descriptor.
#pragma once

#include <cstdint>
#include <string>

#include "plugin/registry.h"

#define SEMFIELD_STRINGIFY_(x) #x
#define SEMFIELD_STRINGIFY(x) SEMFIELD_STRINGIFY_(x)
#ifdef _GLIBCXX_USE_CXX11_ABI
#define SEMFIELD_ABI_STDLIB "libstdc++-cxx11abi" SEMFIELD_STRINGIFY(_GLIBCXX_USE_CXX11_ABI)
#else
#define SEMFIELD_ABI_STDLIB "other-stdlib"
#endif
#if defined(_GLIBCXX_DEBUG)
#define SEMFIELD_ABI_DEBUG "-debugstl"
#else
#define SEMFIELD_ABI_DEBUG ""
#endif
// g++ and clang++ both follow the Itanium C++ ABI but number it differently (1017 and 1002); from 1002 on class
// layouts, virtual tables and names of what crosses this border agree, so a plugin of one works in a framework of the
// other.
#if defined(__GXX_ABI_VERSION) && __GXX_ABI_VERSION >= 1002
#define SEMFIELD_ABI_CXX "itanium"
#else
#define SEMFIELD_ABI_CXX "other-cxx-abi"
#endif
/// C++ ABI, standard library with its string layout, and debug containers of whatever is compiled with this header.
#define SEMFIELD_ABI_TAG SEMFIELD_ABI_CXX "-" SEMFIELD_ABI_STDLIB SEMFIELD_ABI_DEBUG

namespace semfield {

/// Raised whenever an interface in plugin/ changes.
inline constexpr int kPluginApi = 16;

/// The framework's own SEMFIELD_ABI_TAG, to be compared with the one that a module was compiled with.
const char* abi_tag_of_framework();

/// Throws Error(unavailable) naming both sides when a module of this API number and ABI tag does not fit this
/// framework.
void check_interface(int api, const std::string& abi_tag);

struct PluginModule {
  int api = 0;
  const char* abi_tag = "";
  const char* name = "";
  const char* version = "";
  void (*register_into)(Registry&) = nullptr;
};

/// The same facts of a loadable module for a reader of its file: they are in the section kPluginSection, where they
/// are compared before any code of the module runs.
inline constexpr const char* kPluginSection = ".semfield_plugin";
struct PluginStamp {
  char magic[16] = "semfield plugin";
  std::int32_t api = kPluginApi;
  char abi_tag[236] = {};
};
static_assert(sizeof(PluginStamp) == 256);

}  // namespace semfield


#define SEMFIELD_PLUGIN_STAMP                                                                        \
  __attribute__((visibility("default"))) extern const ::semfield::PluginStamp semfield_plugin_stamp; \
  __attribute__((section(".semfield_plugin"), used))                                                 \
  const ::semfield::PluginStamp semfield_plugin_stamp = {"semfield plugin", ::semfield::kPluginApi, SEMFIELD_ABI_TAG};

/// The library of a loadable plugin's CUDA kernels, NAME_cuda.so next to NAME.so: the stamp, and a function that adds
/// them. cmake/SemfieldPlugin.cmake writes the line.
#define SEMFIELD_PLUGIN_CUDA_KERNELS(add_function)                                                                \
  extern "C" {                                                                                                    \
  SEMFIELD_PLUGIN_STAMP                                                                                           \
  __attribute__((visibility("default"))) void semfield_plugin_cuda_kernels(::semfield::KernelTables& tables);     \
  void semfield_plugin_cuda_kernels(::semfield::KernelTables& tables) { ::semfield::cuda::add_function(tables); } \
  }

/// Last line of a plugin, with a function or a lambda that gets the Registry and adds to it. Linked build (inside
/// namespace semfield): a function semfield_module_<name>() that the generated table calls. Loadable build
/// (SEMFIELD_LOADABLE_MODULE defined): the exported symbols semfield_plugin_module and semfield_plugin_stamp, which
/// stands in a section of its own.
#ifdef SEMFIELD_LOADABLE_MODULE
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, ...)                                                   \
  extern "C" {                                                                                                     \
  SEMFIELD_PLUGIN_STAMP                                                                                            \
  __attribute__((visibility("default"))) extern const ::semfield::PluginModule semfield_plugin_module;             \
  const ::semfield::PluginModule semfield_plugin_module = {::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, \
                                                           module_version, __VA_ARGS__};                           \
  }
#else
#define SEMFIELD_PLUGIN_MODULE(module_name, module_version, ...)                                         \
  const ::semfield::PluginModule& semfield_module_##module_name() {                                      \
    static const ::semfield::PluginModule module{::semfield::kPluginApi, SEMFIELD_ABI_TAG, #module_name, \
                                                 module_version, __VA_ARGS__};                           \
    return module;                                                                                       \
  }
#endif
