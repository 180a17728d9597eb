# semfield_add_test(NAME name SOURCES a.cpp ...): one GoogleTest program linked with the framework, the linked plugins and the testkit.
include(GoogleTest)
function(semfield_add_test)
  cmake_parse_arguments(ARG "" "NAME" "SOURCES;LIBRARIES;LABELS" ${ARGN})
  add_executable(${ARG_NAME} ${ARG_SOURCES})
  target_link_libraries(${ARG_NAME} PRIVATE semfield semfield_plugins semfield_testkit semfield_warnings GTest::gtest_main ${ARG_LIBRARIES})
  target_compile_definitions(${ARG_NAME} PRIVATE SEMFIELD_SOURCE_DIR="${PROJECT_SOURCE_DIR}" SEMFIELD_BINARY_DIR="${PROJECT_BINARY_DIR}")
  target_include_directories(${ARG_NAME} PRIVATE ${PROJECT_SOURCE_DIR})
  gtest_discover_tests(${ARG_NAME} DISCOVERY_TIMEOUT 60 PROPERTIES TIMEOUT 600 LABELS "${ARG_LABELS}"
                       # Tests run beside each other: threads that wait must not spin.
                       ENVIRONMENT "OMP_WAIT_POLICY=passive")
endfunction()
