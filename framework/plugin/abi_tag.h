// Facts that a plugin and the framework must share, as one string compiled into both.
#pragma once

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
