# semfield_add_test(NAME name SOURCES a.cpp ... [LIBRARIES ...] [LABELS ...]): one GoogleTest program linked with the framework,
# the linked plugins and the testkit.
include(GoogleTest)
function(semfield_add_test)
  cmake_parse_arguments(ARG "" "NAME" "SOURCES;LIBRARIES;LABELS" ${ARGN})
  add_executable(${ARG_NAME} ${ARG_SOURCES})
  target_link_libraries(${ARG_NAME} PRIVATE semfield semfield_plugins semfield_testkit semfield_warnings GTest::gtest_main ${ARG_LIBRARIES})
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_SOURCE_DIR="${PROJECT_SOURCE_DIR}" SEMFIELD_BINARY_DIR="${PROJECT_BINARY_DIR}")
  target_include_directories(${ARG_NAME} PRIVATE ${PROJECT_SOURCE_DIR})
  # Tests run beside each other: threads that wait must not spin.
  set(properties TIMEOUT 600 ENVIRONMENT OMP_WAIT_POLICY=passive)
  if(ARG_LABELS)
    list(APPEND properties LABELS ${ARG_LABELS})
  endif()
  gtest_discover_tests(${ARG_NAME} DISCOVERY_TIMEOUT 60 PROPERTIES ${properties})
endfunction()
