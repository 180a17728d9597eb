# Kernels compiled once per instruction set, chosen when the program starts (compute/isa.h).
#
# SEMFIELD_ISAS lists the variants. "build" alone means one variant with the compiler flags of the build (SEMFIELD_MARCH): quick to compile, for
# development and sanitizers, and for processors other than x86-64.
set(semfield_default_isas build)
if(CMAKE_BUILD_TYPE STREQUAL "Release" AND NOT SEMFIELD_SANITIZE AND NOT SEMFIELD_MARCH AND CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
  set(semfield_default_isas generic avx2 avx512 avx512_bf16)
endif()
set(SEMFIELD_ISAS "${semfield_default_isas}" CACHE STRING "Instruction sets of the kernels: generic;avx2;avx512;avx512_bf16, or build")

set(SEMFIELD_ISA_FLAGS_generic "")
set(SEMFIELD_ISA_FLAGS_build "")
set(SEMFIELD_ISA_FLAGS_avx2 -march=x86-64-v3)
# Left to itself GCC vectorises with half-width registers.
set(SEMFIELD_ISA_FLAGS_avx512 -march=x86-64-v4 -mprefer-vector-width=512)
set(SEMFIELD_ISA_FLAGS_avx512_bf16 ${SEMFIELD_ISA_FLAGS_avx512} -mavx512bf16)

# Variants that have kernels of their own; avx512_bf16 differs from avx512 in the few files of ALL_ISAS alone.
set(SEMFIELD_KERNEL_ISAS ${SEMFIELD_ISAS})
list(REMOVE_ITEM SEMFIELD_KERNEL_ISAS avx512_bf16)

# SEMFIELD_FOR_EACH_ISA(X) expands to X(generic) X(avx2) ...: what dispatchers are written with.
function(semfield_isa_macro name isas)
  list(TRANSFORM isas REPLACE "(.+)" "X(\\1)" OUTPUT_VARIABLE calls)
  list(JOIN calls " " calls)
  set(semfield_isa_macros "${semfield_isa_macros}#define ${name}(X) ${calls}\n" PARENT_SCOPE)
endfunction()
set(semfield_isa_macros "// Generated: the instruction sets that this build has kernels for.\n#pragma once\n\n")
semfield_isa_macro(SEMFIELD_FOR_EACH_ISA "${SEMFIELD_KERNEL_ISAS}")
semfield_isa_macro(SEMFIELD_FOR_EVERY_ISA "${SEMFIELD_ISAS}")
file(CONFIGURE OUTPUT ${PROJECT_BINARY_DIR}/generated/isa_list.h CONTENT "${semfield_isa_macros}" @ONLY)

# semfield_kernel_objects(out prefix [ALL_ISAS] files...): compiles the files once per variant, each in namespace semfield::isa_<variant>
# (SEMFIELD_ISA), and gives the names of the object libraries. Such a file keeps everything of its own in an unnamed or in that namespace: an
# inline function shared with other files could be linked from a variant that this processor lacks (tests/architecture looks at the objects).
function(semfield_kernel_objects out prefix)
  cmake_parse_arguments(ARG "ALL_ISAS" "" "" ${ARGN})
  set(isas ${SEMFIELD_KERNEL_ISAS})
  if(ARG_ALL_ISAS)
    set(isas ${SEMFIELD_ISAS})
  endif()
  list(TRANSFORM ARG_UNPARSED_ARGUMENTS PREPEND "${CMAKE_CURRENT_SOURCE_DIR}/" OUTPUT_VARIABLE files)
  set(variants "")
  foreach(isa ${isas})
    set(variant ${prefix}_${isa})
    add_library(${variant} OBJECT ${files})
    target_compile_options(${variant} PRIVATE ${SEMFIELD_ISA_FLAGS_${isa}})
    target_compile_definitions(${variant} PRIVATE SEMFIELD_ISA=isa_${isa} SEMFIELD_KERNEL_FILE)
    target_include_directories(${variant} PRIVATE ${PROJECT_SOURCE_DIR}/framework ${PROJECT_SOURCE_DIR}/plugins)
    target_link_libraries(${variant} PRIVATE semfield_warnings)
    list(APPEND variants ${variant})
  endforeach()
  set_property(GLOBAL APPEND PROPERTY SEMFIELD_KERNEL_OBJECTS ${variants})
  set(${out} ${variants} PARENT_SCOPE)
endfunction()

# semfield_link_kernels(target variants...): links such objects into a library.
function(semfield_link_kernels target)
  foreach(variant ${ARGN})
    target_sources(${target} PRIVATE $<TARGET_OBJECTS:${variant}>)
  endforeach()
endfunction()
