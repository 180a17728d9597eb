# What `cmake --install` gives. Components: "runtime" = the libraries, in a folder of their own, "app" = the command and what it reads, "sdk" =
# headers, testkit and the CMake package, "python" = the module (python/CMakeLists.txt). No path of the build tree or of the prefix may leak
# into them: an installed prefix can be moved.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

set(semfield_library_dir ${CMAKE_INSTALL_LIBDIR}/semfield)  # ours alone: their names and interfaces may change with every major version
set(semfield_package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/semfield)

# Exported names are semfield::sdk, semfield::testkit, semfield::plugins and semfield::cuda.
set_target_properties(semfield PROPERTIES EXPORT_NAME sdk)
set_target_properties(semfield_testkit PROPERTIES EXPORT_NAME testkit)
set_target_properties(semfield_plugins PROPERTIES EXPORT_NAME plugins INTERFACE_INCLUDE_DIRECTORIES "$<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/plugins>")
target_compile_features(semfield INTERFACE cxx_std_20)

install(TARGETS semfield semfield_testkit semfield_plugins EXPORT semfieldTargets
        LIBRARY DESTINATION ${semfield_library_dir} COMPONENT runtime NAMELINK_COMPONENT sdk
        ARCHIVE DESTINATION ${semfield_library_dir} COMPONENT sdk)
install(EXPORT semfieldTargets NAMESPACE semfield:: DESTINATION ${semfield_package_dir} COMPONENT sdk)
if(TARGET semfield_cuda)  # kernels of plugins outside link with it
  set_target_properties(semfield_cuda PROPERTIES EXPORT_NAME cuda)
  install(TARGETS semfield_cuda EXPORT semfieldCudaTargets LIBRARY DESTINATION ${semfield_library_dir} COMPONENT runtime NAMELINK_COMPONENT sdk)
  install(EXPORT semfieldCudaTargets NAMESPACE semfield:: DESTINATION ${semfield_package_dir} COMPONENT sdk)
endif()
# Loaded late by the framework's library, which looks for them beside itself; the probe is a program that semfield_numerics starts.
foreach(companion semfield_images semfield_mpi semfield_nccl semfield_numerics semfield_step_probe semfield_laws semfield_bench semfield_python)
  if(TARGET ${companion})
    set(component runtime)
    if(companion STREQUAL "semfield_python")  # with the Python that it embeds
      set(component python)
    endif()
    install(TARGETS ${companion} RUNTIME DESTINATION ${semfield_library_dir} COMPONENT ${component}
            LIBRARY DESTINATION ${semfield_library_dir} COMPONENT ${component})
  endif()
endforeach()
foreach(beside semfield semfield_plugins semfield_cuda semfield_images semfield_mpi semfield_nccl semfield_numerics semfield_step_probe semfield_laws semfield_bench semfield_python)
  if(TARGET ${beside})
    set_target_properties(${beside} PROPERTIES INSTALL_RPATH "$ORIGIN")
  endif()
endforeach()
install(DIRECTORY ${PROJECT_SOURCE_DIR}/framework/ DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/semfield COMPONENT sdk
        FILES_MATCHING PATTERN "*.h" PATTERN "*.cuh")

configure_package_config_file(${PROJECT_SOURCE_DIR}/cmake/semfieldConfig.cmake.in ${PROJECT_BINARY_DIR}/semfieldConfig.cmake
                              INSTALL_DESTINATION ${semfield_package_dir} NO_SET_AND_CHECK_MACRO)
# Sources of plugins compile within a major version; the loader's API number refuses modules of another at run time.
write_basic_package_version_file(${PROJECT_BINARY_DIR}/semfieldConfigVersion.cmake COMPATIBILITY SameMajorVersion)
install(FILES ${PROJECT_BINARY_DIR}/semfieldConfig.cmake ${PROJECT_BINARY_DIR}/semfieldConfigVersion.cmake
              ${PROJECT_SOURCE_DIR}/cmake/KernelObjects.cmake ${PROJECT_SOURCE_DIR}/cmake/SemfieldPlugin.cmake
        DESTINATION ${semfield_package_dir} COMPONENT sdk)

set_target_properties(semfield_app PROPERTIES INSTALL_RPATH "$ORIGIN/../${semfield_library_dir}")
install(TARGETS semfield_app RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR} COMPONENT app)
foreach(folder configs scenes app/serve/page)  # found by core/files.h under the same names as in the source tree
  install(DIRECTORY ${PROJECT_SOURCE_DIR}/${folder}/ DESTINATION ${CMAKE_INSTALL_DATADIR}/semfield/${folder} COMPONENT app)
endforeach()

# Completions, which the program itself prints, and a manual page of its help.
set(semfield_words ${PROJECT_BINARY_DIR}/words)
file(MAKE_DIRECTORY ${semfield_words})
add_custom_command(OUTPUT ${semfield_words}/made
  COMMAND ${PROJECT_SOURCE_DIR}/packaging/manual_page $<TARGET_FILE:semfield_app> ${PROJECT_VERSION} > ${semfield_words}/semfield.1
  COMMAND gzip -9nf ${semfield_words}/semfield.1
  COMMAND semfield_app help --completion > ${semfield_words}/semfield
  COMMAND ${CMAKE_COMMAND} -E touch ${semfield_words}/made
  DEPENDS semfield_app ${PROJECT_SOURCE_DIR}/packaging/manual_page COMMENT "Manual page and completions")
add_custom_target(semfield_words ALL DEPENDS ${semfield_words}/made)
install(FILES ${semfield_words}/semfield.1.gz DESTINATION ${CMAKE_INSTALL_MANDIR}/man1 COMPONENT app)
install(FILES ${semfield_words}/semfield DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions COMPONENT app)
install(FILES ${semfield_words}/semfield DESTINATION ${CMAKE_INSTALL_DATADIR}/zsh/vendor-completions RENAME _semfield COMPONENT app)
