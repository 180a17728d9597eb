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
/// The Itanium ABI version is shared by g++ and clang++, so both may build plugins for one framework.
#define SEMFIELD_ABI_TAG "cxx" SEMFIELD_STRINGIFY(__GXX_ABI_VERSION) "-" SEMFIELD_ABI_STDLIB SEMFIELD_ABI_DEBUG
