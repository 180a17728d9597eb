# semfield_add_plugin(KIND encoders NAME hash_grid SOURCES a.cpp b.cpp [CPU hash_grid_cpu.cpp] [CUDA hash_grid_cuda.cu] [LIBRARIES ...])
# One line a plugin. Adds its sources to semfield_plugins, its `*_test.cpp` to the test suite, and its module to the
# generated table of linked plugins. With CPU: generates `void <name>_kernels(KernelTables&)`, which calls <name>_cpu_kernels and, in a
# build with CUDA, <name>_cuda_kernels.
function(semfield_add_plugin)
  cmake_parse_arguments(ARG "" "NAME" "SOURCES;CPU;CUDA;LIBRARIES" ${ARGN})
  if(NOT ARG_NAME)
    get_filename_component(ARG_NAME ${CMAKE_CURRENT_SOURCE_DIR} NAME)
  endif()
  set(target semfield_plugin_${ARG_NAME})
  add_library(${target} OBJECT ${ARG_SOURCES} ${ARG_CPU})
  if(ARG_CPU)
    set(generated ${CMAKE_CURRENT_BINARY_DIR}/${ARG_NAME}_devices.cpp)
    file(GENERATE OUTPUT ${generated} CONTENT
"// Generated: the kernel tables that this build has for '${ARG_NAME}'.
#include \"plugin/kernels.h\"
namespace semfield {
void ${ARG_NAME}_cpu_kernels(KernelTables& tables);
void ${ARG_NAME}_kernels(KernelTables& tables);
void ${ARG_NAME}_kernels(KernelTables& tables) { ${ARG_NAME}_cpu_kernels(tables); }
}  // namespace semfield
")
    target_sources(${target} PRIVATE ${generated})
  endif()
  target_link_libraries(${target} PUBLIC semfield PRIVATE semfield_warnings ${ARG_LIBRARIES})
  target_include_directories(${target} PUBLIC ${PROJECT_SOURCE_DIR}/plugins)
  set_property(GLOBAL APPEND PROPERTY SEMFIELD_LINKED_PLUGINS ${ARG_NAME})
  set_property(GLOBAL APPEND PROPERTY SEMFIELD_PLUGIN_LIBRARIES ${ARG_LIBRARIES})
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
