# semfield_add_test(NAME name [SOURCES a.cpp ...] [LIBRARIES ...] [LABELS ...] [PROGRAM target] [NEEDS target ...] [DEVICE]): one
# GoogleTest program of the folder's *_test.cpp (or of SOURCES), linked with the framework, the linked plugins and the testkit. PROGRAM
# is what its tests start, SEMFIELD_BINARY in their sources; it and NEEDS are built before. Without DEVICE its tests see no device of
# the machine: `runtime.device: auto` is the CPU, and golden values are the same everywhere.
include(GoogleTest)
add_library(semfield_no_cache OBJECT ${PROJECT_SOURCE_DIR}/tests/no_cache.cpp)
function(semfield_add_test)
  cmake_parse_arguments(ARG "DEVICE" "NAME;PROGRAM" "SOURCES;LIBRARIES;LABELS;NEEDS" ${ARGN})
  if(NOT ARG_SOURCES)
    file(GLOB ARG_SOURCES CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*_test.cpp)
  endif()
  add_executable(${ARG_NAME} ${ARG_SOURCES} $<TARGET_OBJECTS:semfield_no_cache>)
  target_link_libraries(${ARG_NAME} PRIVATE $<TARGET_NAME_IF_EXISTS:semfield_train_testing> semfield semfield_plugins semfield_testkit semfield_warnings GTest::gtest_main ${ARG_LIBRARIES})
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_SOURCE_DIR="${PROJECT_SOURCE_DIR}" SEMFIELD_BINARY_DIR="${PROJECT_BINARY_DIR}")
  target_include_directories(${ARG_NAME} PRIVATE ${PROJECT_SOURCE_DIR})
  # Two thirds of a build are tests. Libraries, of which some are installed, keep their own level.
  target_compile_options(${ARG_NAME} PRIVATE $<$<AND:$<CONFIG:Release>,$<COMPILE_LANGUAGE:CXX>>:-O1>)
  if(ARG_PROGRAM)
    target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_BINARY="$<TARGET_FILE:${ARG_PROGRAM}>")
  endif()
  if(ARG_PROGRAM OR ARG_NEEDS)
    add_dependencies(${ARG_NAME} ${ARG_PROGRAM} ${ARG_NEEDS})
  endif()
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

# semfield_add_program_test(NAME FILE.py [NAME=VALUE ...]): a test in Python that runs the program (by tests/program.py, which it finds), with these
# in its environment.
function(semfield_add_program_test name file)
  find_package(Python3 COMPONENTS Interpreter)
  if(Python3_Interpreter_FOUND)
    add_test(NAME ${name} COMMAND ${Python3_EXECUTABLE} -B ${CMAKE_CURRENT_SOURCE_DIR}/${file})
    set_tests_properties(${name} PROPERTIES TIMEOUT 3600 SKIP_RETURN_CODE 77 ENVIRONMENT
      "PYTHONPATH=${PROJECT_SOURCE_DIR}/tests;SEMFIELD_BINARY=$<TARGET_FILE:semfield_app>;SEMFIELD_ANALYTIC_ROOM=$<TARGET_FILE:semfield_analytic_room>;SEMFIELD_CACHE=off;OMP_WAIT_POLICY=passive;CUDA_VISIBLE_DEVICES=;${ARGN}")
  else()
    message(WARNING "${name} is not tested: python3 is not here")
  endif()
endfunction()

# semfield_test_every_isa(name [filter]): runs the whole program, or the tests of a filter, once more for each weaker instruction set of the
# build that the configuring machine has; its own tests run on the best one.
function(semfield_test_every_isa name)
  set(cpu_flags "")
  if(EXISTS /proc/cpuinfo)
    file(STRINGS /proc/cpuinfo cpu_flags REGEX "^flags" LIMIT_COUNT 1)
  endif()
  set(usable "")
  foreach(isa ${SEMFIELD_ISAS})
    string(REPLACE "avx512" "avx512f" flag " ${isa} ")
    string(REPLACE "avx512f_bf16" "avx512_bf16" flag "${flag}")
    string(REPLACE "amx_emulated" "avx512_bf16" flag "${flag}")
    if(isa STREQUAL "generic" OR "${cpu_flags} " MATCHES "${flag}")
      list(APPEND usable ${isa})
    endif()
  endforeach()
  set(choices ${usable})
  list(REMOVE_ITEM choices amx_emulated)  # on request alone
  if(choices)
    list(GET choices -1 best)
    list(REMOVE_ITEM usable ${best})
  endif()
  foreach(isa ${usable})
    add_test(NAME ${name}.${isa} COMMAND ${name} --gtest_brief=1 ${ARGN})
    set_tests_properties(${name}.${isa} PROPERTIES TIMEOUT 600 ENVIRONMENT "SEMFIELD_ISA=${isa};OMP_WAIT_POLICY=passive;CUDA_VISIBLE_DEVICES=")
  endforeach()
endfunction()
