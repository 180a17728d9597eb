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
  # The folder of the plugins' kinds: plugins/, or that of SEMFIELD_EXTRA_PARTS.
  get_filename_component(semfield_plugin_root ${CMAKE_CURRENT_SOURCE_DIR}/../.. ABSOLUTE)
  add_library(${target} OBJECT ${ARG_SOURCES})
  if(ARG_CPU)
    semfield_kernel_objects(kernels ${target} ${ARG_CPU})
    if(ARG_SAME_BITS)
      foreach(variant ${kernels})
        target_compile_options(${variant} PRIVATE -ffp-contract=off)
      endforeach()
    endif()
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_KERNELS ${kernels})
    semfield_kernel_dispatch(${target} ${ARG_NAME})
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
  target_include_directories(${target} PUBLIC ${PROJECT_SOURCE_DIR}/plugins PRIVATE ${semfield_plugin_root})
  set_property(GLOBAL APPEND PROPERTY SEMFIELD_LINKED_PLUGINS ${ARG_NAME})
  file(GLOB tests CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*_test.cpp)
  foreach(test_file ${tests})
    set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_TESTS ${test_file})
  endforeach()
endfunction()

# semfield_add_loadable_plugin(NAME waves SOURCES waves.cpp ... [CPU waves_cpu.cpp] [SAME_BITS] [CUDA waves_cuda.cu] [LIBRARIES ...]): waves.so,
# for --plugin path/waves.so. The same sources as a linked plugin, and the same meaning of CPU, SAME_BITS and CUDA; for projects outside the tree
# that found the package. CUDA kernels become waves_cuda.so beside it, which is loaded when a run asks for the device; they need
# find_package(semfield REQUIRED OPTIONAL_COMPONENTS cuda), and are left out with a message where that component is not found.
function(semfield_add_loadable_plugin)
  cmake_parse_arguments(ARG "SAME_BITS" "NAME" "SOURCES;CPU;CUDA;LIBRARIES" ${ARGN})
  if(NOT ARG_NAME OR NOT ARG_SOURCES)
    message(FATAL_ERROR "semfield_add_loadable_plugin needs NAME and SOURCES")
  endif()
  add_library(${ARG_NAME} MODULE ${ARG_SOURCES})
  set_target_properties(${ARG_NAME} PROPERTIES PREFIX "")
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_LOADABLE_MODULE)
  target_link_libraries(${ARG_NAME} PRIVATE semfield::sdk ${ARG_LIBRARIES})
  if(ARG_CPU)
    semfield_kernel_objects(kernels ${ARG_NAME} ${ARG_CPU})
    if(ARG_SAME_BITS)
      foreach(variant ${kernels})
        target_compile_options(${variant} PRIVATE -ffp-contract=off)
      endforeach()
    endif()
    semfield_link_kernels(${ARG_NAME} ${kernels})
    semfield_kernel_dispatch(${ARG_NAME} ${ARG_NAME})
  endif()
  if(ARG_CUDA AND NOT TARGET semfield::cuda)
    message(STATUS "${ARG_NAME}: its CUDA kernels are left out; the installed semfield has no component 'cuda', or no CUDA compiler was found")
  elseif(ARG_CUDA)
    set(generated ${CMAKE_CURRENT_BINARY_DIR}/${ARG_NAME}_cuda_module.cpp)
    file(GENERATE OUTPUT ${generated} CONTENT
"// Generated: what the CUDA kernels of '${ARG_NAME}' export.
#include \"plugin/module.h\"
namespace semfield::cuda {
void ${ARG_NAME}_cuda_kernels(KernelTables& tables);
}
SEMFIELD_PLUGIN_CUDA_KERNELS(${ARG_NAME}_cuda_kernels)
")
    add_library(${ARG_NAME}_cuda MODULE ${ARG_CUDA} ${generated})
    set_target_properties(${ARG_NAME}_cuda PROPERTIES PREFIX "" LIBRARY_OUTPUT_DIRECTORY $<TARGET_FILE_DIR:${ARG_NAME}>)
    target_compile_options(${ARG_NAME}_cuda PRIVATE "$<$<COMPILE_LANGUAGE:CUDA>:--expt-relaxed-constexpr;--diag-suppress=20012>")
    if(ARG_SAME_BITS)
      target_compile_options(${ARG_NAME}_cuda PRIVATE "$<$<COMPILE_LANGUAGE:CUDA>:-fmad=false>")
    endif()
    target_link_libraries(${ARG_NAME}_cuda PRIVATE semfield::cuda)
    add_dependencies(${ARG_NAME} ${ARG_NAME}_cuda)
  endif()
endfunction()
