# Kernels compiled once per instruction set: of this tree, and of projects that found the package, which has the variants of its framework.
set(SEMFIELD_ISA_FLAGS_generic "")
set(SEMFIELD_ISA_FLAGS_build "")
set(SEMFIELD_ISA_FLAGS_avx2 -march=x86-64-v3)
# Left to itself GCC vectorises with half-width registers.
set(SEMFIELD_ISA_FLAGS_avx512 -march=x86-64-v4 -mprefer-vector-width=512)
set(SEMFIELD_ISA_FLAGS_avx512_bf16 ${SEMFIELD_ISA_FLAGS_avx512} -mavx512bf16)
set(SEMFIELD_ISA_FLAGS_amx_emulated ${SEMFIELD_ISA_FLAGS_avx512_bf16} -DSEMFIELD_TILES=EmulatedTiles)
set(SEMFIELD_ISA_FLAGS_amx_bf16 ${SEMFIELD_ISA_FLAGS_avx512_bf16} -DSEMFIELD_TILES=HardwareTiles)

# semfield_kernel_objects(out prefix [ALL_ISAS] files...): compiles the files once per variant, each in namespace semfield::isa_<variant>
# (SEMFIELD_ISA), and gives the names of the object libraries. Such a file keeps everything of its own in an unnamed or in that namespace: an
# inline function shared with other files could be linked from a variant that this CPU lacks (tests/architecture looks at the objects).
function(semfield_kernel_objects out prefix)
  cmake_parse_arguments(ARG "ALL_ISAS" "" "" ${ARGN})
  set(isas ${SEMFIELD_KERNEL_ISAS})
  if(ARG_ALL_ISAS)
    set(isas ${SEMFIELD_ISAS})
  endif()
  set(files "")
  foreach(file ${ARG_UNPARSED_ARGUMENTS})
    get_filename_component(file ${file} ABSOLUTE)
    list(APPEND files ${file})
  endforeach()
  set(variants "")
  foreach(isa ${isas})
    set(variant ${prefix}_${isa})
    add_library(${variant} OBJECT ${files})
    target_compile_options(${variant} PRIVATE ${SEMFIELD_ISA_FLAGS_${isa}})
    target_compile_definitions(${variant} PRIVATE SEMFIELD_ISA=isa_${isa} SEMFIELD_KERNEL_FILE)
    set_target_properties(${variant} PROPERTIES POSITION_INDEPENDENT_CODE ON UNITY_BUILD OFF)
    if(SEMFIELD_FROM_PACKAGE)
      target_compile_options(${variant} PRIVATE -ffp-contract=fast -fno-math-errno -fno-trapping-math)
      target_link_libraries(${variant} PRIVATE semfield::sdk)
    else()
      target_include_directories(${variant} PRIVATE ${PROJECT_SOURCE_DIR}/framework ${PROJECT_SOURCE_DIR}/plugins ${semfield_plugin_root})
      target_link_libraries(${variant} PRIVATE semfield_warnings)
    endif()
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

# semfield_kernel_dispatch(target name): adds a source with `void <name>_kernels(KernelTables&)`, which calls <name>_cpu_kernels of the
# instruction set in use (compute/isa.h).
function(semfield_kernel_dispatch target name)
  set(declarations "")
  set(variants "")
  foreach(isa ${SEMFIELD_KERNEL_ISAS})
    string(APPEND declarations "namespace isa_${isa} { void ${name}_cpu_kernels(KernelTables& tables); }\n")
    string(APPEND variants "      {Isa::${isa}, isa_${isa}::${name}_cpu_kernels},\n")
  endforeach()
  set(generated ${CMAKE_CURRENT_BINARY_DIR}/${name}_devices.cpp)
  file(GENERATE OUTPUT ${generated} CONTENT
"// Generated: the kernel tables that this build has for '${name}'.
#include \"compute/isa.h\"
#include \"plugin/kernels.h\"
namespace semfield {
${declarations}
void ${name}_kernels(KernelTables& tables);
void ${name}_kernels(KernelTables& tables) {
  static constexpr IsaVariant<void (*)(KernelTables&)> kVariants[] = {
${variants}  };
  best_variant(kVariants)(tables);
}
}  // namespace semfield
")
  target_sources(${target} PRIVATE ${generated})
endfunction()
