# Kernels compiled once per instruction set, chosen when the program starts (compute/isa.h).
#
# SEMFIELD_ISAS lists the variants. "build" alone means one variant with the compiler flags of the build (SEMFIELD_MARCH): quick to compile, for
# development and sanitizers, and for CPUs other than x86-64.
set(semfield_default_isas build)
if(CMAKE_BUILD_TYPE STREQUAL "Release" AND NOT SEMFIELD_SANITIZE AND NOT SEMFIELD_MARCH AND CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
  set(semfield_default_isas generic avx2 avx512 avx512_bf16 amx_emulated amx_bf16)
endif()
set(SEMFIELD_ISAS "${semfield_default_isas}" CACHE STRING "Instruction sets of the kernels: generic;avx2;avx512;avx512_bf16;amx_emulated;amx_bf16, or build")

include(${CMAKE_CURRENT_LIST_DIR}/KernelObjects.cmake)

# Variants that have kernels of their own; these differ from avx512 in the few files of ALL_ISAS alone.
set(SEMFIELD_KERNEL_ISAS ${SEMFIELD_ISAS})
list(REMOVE_ITEM SEMFIELD_KERNEL_ISAS avx512_bf16 amx_emulated amx_bf16)

# SEMFIELD_FOR_EACH_ISA(X, more) expands to X(generic, more) X(avx2, more) ...: what dispatchers are written with.
function(semfield_isa_macro name isas)
  list(TRANSFORM isas REPLACE "(.+)" "X(\\1 __VA_OPT__(,) __VA_ARGS__)" OUTPUT_VARIABLE calls)
  list(JOIN calls " " calls)
  set(semfield_isa_macros "${semfield_isa_macros}#define ${name}(X, ...) ${calls}\n" PARENT_SCOPE)
endfunction()
set(semfield_isa_macros "// Generated: the instruction sets that this build has kernels for.\n#pragma once\n\n")
semfield_isa_macro(SEMFIELD_FOR_EACH_ISA "${SEMFIELD_KERNEL_ISAS}")
semfield_isa_macro(SEMFIELD_FOR_EVERY_ISA "${SEMFIELD_ISAS}")
file(CONFIGURE OUTPUT ${PROJECT_BINARY_DIR}/generated/isa_list.h CONTENT "${semfield_isa_macros}" @ONLY)
