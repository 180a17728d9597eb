# semfield_add_test(NAME name SOURCES a.cpp ... [LIBRARIES ...] [LABELS ...] [DEVICE]): one GoogleTest program linked with the
# framework, the linked plugins and the testkit. Without DEVICE its tests see no device of the machine: `runtime.device: auto` is the
# processor, and golden values are the same everywhere.
include(GoogleTest)
add_library(semfield_no_cache OBJECT ${PROJECT_SOURCE_DIR}/tests/no_cache.cpp)
function(semfield_add_test)
  cmake_parse_arguments(ARG "DEVICE" "NAME" "SOURCES;LIBRARIES;LABELS" ${ARGN})
  add_executable(${ARG_NAME} ${ARG_SOURCES} $<TARGET_OBJECTS:semfield_no_cache>)
  target_link_libraries(${ARG_NAME} PRIVATE semfield semfield_plugins semfield_testkit semfield_warnings GTest::gtest_main ${ARG_LIBRARIES})
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_SOURCE_DIR="${PROJECT_SOURCE_DIR}" SEMFIELD_BINARY_DIR="${PROJECT_BINARY_DIR}")
  target_include_directories(${ARG_NAME} PRIVATE ${PROJECT_SOURCE_DIR})
  foreach(companion semfield_images)  # loaded at run time, so no link asks for them
    if(TARGET ${companion})
      add_dependencies(${ARG_NAME} ${companion})
    endif()
  endforeach()
  # Tests run beside each other: threads that wait must not spin.
  set(properties TIMEOUT 600 ENVIRONMENT OMP_WAIT_POLICY=passive)
  if(NOT ARG_DEVICE)
    list(APPEND properties ENVIRONMENT_MODIFICATION CUDA_VISIBLE_DEVICES=set:)
  endif()
  if(ARG_LABELS)
    list(APPEND properties LABELS ${ARG_LABELS})
  endif()
  # Names of parameterised tests are those that the suites give, not how a value prints.
  gtest_discover_tests(${ARG_NAME} NO_PRETTY_VALUES DISCOVERY_TIMEOUT 60 PROPERTIES ${properties})
endfunction()

# semfield_test_every_isa(name): runs the whole program once more for each weaker instruction set of the build that the configuring machine has.
function(semfield_test_every_isa name)
  set(cpu_flags "")
  if(EXISTS /proc/cpuinfo)
    file(STRINGS /proc/cpuinfo cpu_flags REGEX "^flags" LIMIT_COUNT 1)
  endif()
  foreach(isa ${SEMFIELD_ISAS})
    string(REPLACE "avx512" "avx512f" flag " ${isa} ")
    string(REPLACE "avx512f_bf16" "avx512_bf16" flag "${flag}")
    string(REPLACE "amx_emulated" "avx512_bf16" flag "${flag}")
    if(isa STREQUAL "generic" OR "${cpu_flags} " MATCHES "${flag}")
      add_test(NAME ${name}.${isa} COMMAND ${name} --gtest_brief=1)
      set_tests_properties(${name}.${isa} PROPERTIES TIMEOUT 600 ENVIRONMENT "SEMFIELD_ISA=${isa};OMP_WAIT_POLICY=passive;CUDA_VISIBLE_DEVICES=")
    endif()
  endforeach()
endfunction()
