# semfield_add_plugin(KIND encoders NAME hash_grid SOURCES a.cpp b.cpp [CPU hash_grid_cpu.cpp] [SAME_BITS] [CUDA hash_grid_cuda.cu]
#                     [LIBRARIES ...])
# One line a plugin. Adds its sources to semfield_plugins, its `*_test.cpp` to the test suite, and its module to the
# generated table of linked plugins. With CPU: compiles those files once per instruction set (cmake/Isa.cmake) and generates
# `void <name>_kernels(KernelTables&)`, which calls <name>_cpu_kernels of the instruction set in use. With CUDA: those files go into the library
# semfield_cuda, which is loaded when a run asks for the device, and `void cuda::<name>_cuda_kernels(KernelTables&)` of them is called then. With SAME_BITS multiplications and additions are never fused, so that every instruction set gives the same values: for
# kernels whose results decide where something lies.
function(semfield_add_plugin)
  cmake_parse_arguments(ARG "SAME_BITS" "NAME" "SOURCES;CPU;CUDA;LIBRARIES" ${ARGN})
  if(NOT ARG_NAME)
    get_filename_component(ARG_NAME ${CMAKE_CURRENT_SOURCE_DIR} NAME)
  endif()
  set(target semfield_plugin_${ARG_NAME})
  add_library(${target} OBJECT ${ARG_SOURCES})
  if(ARG_CPU)
    semfield_kernel_objects(kernels ${target} ${ARG_CPU})
    if(ARG_SAME_BITS)
      foreach(variant ${kernels})
        target_compile_options(${variant} PRIVATE -ffp-contract=off)
      endforeach()
    endif()
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_KERNELS ${kernels})
    set(generated ${CMAKE_CURRENT_BINARY_DIR}/${ARG_NAME}_devices.cpp)
    file(GENERATE OUTPUT ${generated} CONTENT
"// Generated: the kernel tables that this build has for '${ARG_NAME}'.
#include \"compute/isa.h\"
#include \"isa_list.h\"
#include \"plugin/kernels.h\"
namespace semfield {
#define SEMFIELD_DECLARE(name) namespace isa_##name { void ${ARG_NAME}_cpu_kernels(KernelTables& tables); }
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE)
#undef SEMFIELD_DECLARE
void ${ARG_NAME}_kernels(KernelTables& tables);
void ${ARG_NAME}_kernels(KernelTables& tables) {
#define SEMFIELD_LIST(name) {Isa::name, isa_##name::${ARG_NAME}_cpu_kernels},
  static constexpr IsaVariant<void (*)(KernelTables&)> kVariants[] = {SEMFIELD_FOR_EACH_ISA(SEMFIELD_LIST)};
#undef SEMFIELD_LIST
  best_variant(kVariants)(tables);
}
}  // namespace semfield
")
    target_sources(${target} PRIVATE ${generated})
    target_include_directories(${target} PRIVATE ${PROJECT_BINARY_DIR}/generated)
  endif()
  if(ARG_CUDA)
    list(TRANSFORM ARG_CUDA PREPEND "${CMAKE_CURRENT_SOURCE_DIR}/")
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_CUDA_SOURCES ${ARG_CUDA})
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_CUDA_PLUGINS ${ARG_NAME})
    if(ARG_SAME_BITS)
      set_property(GLOBAL APPEND PROPERTY SEMFIELD_CUDA_SAME_BITS ${ARG_CUDA})
    endif()
  endif()
  target_link_libraries(${target} PUBLIC semfield PRIVATE semfield_warnings ${ARG_LIBRARIES})
  target_include_directories(${target} PUBLIC ${PROJECT_SOURCE_DIR}/plugins)
  set_property(GLOBAL APPEND PROPERTY SEMFIELD_LINKED_PLUGINS ${ARG_NAME})
  file(GLOB tests CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*_test.cpp)
  foreach(test_file ${tests})
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_TESTS ${test_file})
  endforeach()
endfunction()

# semfield_add_loadable_plugin(NAME waves SOURCES waves.cpp ... [LIBRARIES ...]): waves.so, for `plugins: [path/waves.so]`. The same sources as a
# linked plugin; for projects outside the tree that found the package.
function(semfield_add_loadable_plugin)
  cmake_parse_arguments(ARG "" "NAME" "SOURCES;LIBRARIES" ${ARGN})
  if(NOT ARG_NAME OR NOT ARG_SOURCES)
    message(FATAL_ERROR "semfield_add_loadable_plugin needs NAME and SOURCES")
  endif()
  add_library(${ARG_NAME} MODULE ${ARG_SOURCES})
  set_target_properties(${ARG_NAME} PROPERTIES PREFIX "")
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_LOADABLE_MODULE)
  target_link_libraries(${ARG_NAME} PRIVATE semfield::sdk ${ARG_LIBRARIES})
endfunction()
