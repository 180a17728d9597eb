# What `cmake --install` gives outside users: component "sdk" = headers, libraries, testkit and the CMake package; component "app" = the
# command and its configs.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

set(semfield_package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/semfield)

# Exported names are semfield::sdk, semfield::testkit and semfield::plugins; no path of the build tree may leak into them.
set_target_properties(semfield PROPERTIES EXPORT_NAME sdk INSTALL_RPATH "$ORIGIN")
set_target_properties(semfield_testkit PROPERTIES EXPORT_NAME testkit)
set_target_properties(semfield_plugins PROPERTIES EXPORT_NAME plugins INSTALL_RPATH "$ORIGIN"
                      INTERFACE_INCLUDE_DIRECTORIES "$<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/plugins>")
target_compile_features(semfield INTERFACE cxx_std_20)

install(TARGETS semfield semfield_testkit semfield_plugins EXPORT semfieldTargets
        LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT sdk NAMELINK_COMPONENT sdk
        ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT sdk)
foreach(companion semfield_images semfield_numerics)  # beside the framework's library, which looks for them there
  if(TARGET ${companion})
    set_target_properties(${companion} PROPERTIES INSTALL_RPATH "$ORIGIN")
    install(TARGETS ${companion} LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT sdk)
  endif()
endforeach()
if(TARGET semfield_cuda)  # beside it too; kernels of plugins outside link with it
  set_target_properties(semfield_cuda PROPERTIES EXPORT_NAME cuda INSTALL_RPATH "$ORIGIN")
  install(TARGETS semfield_cuda EXPORT semfieldCudaTargets LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT sdk NAMELINK_COMPONENT sdk)
  install(EXPORT semfieldCudaTargets NAMESPACE semfield:: DESTINATION ${semfield_package_dir} COMPONENT sdk)
endif()
if(TARGET semfield_step_probe)  # started by semfield_numerics, which looks for it beside itself
  set_target_properties(semfield_step_probe PROPERTIES INSTALL_RPATH "$ORIGIN")
  install(TARGETS semfield_step_probe RUNTIME DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT sdk)
endif()
install(EXPORT semfieldTargets NAMESPACE semfield:: DESTINATION ${semfield_package_dir} COMPONENT sdk)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/framework/ DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/semfield COMPONENT sdk
        FILES_MATCHING PATTERN "*.h" PATTERN "*.cuh")

configure_package_config_file(${PROJECT_SOURCE_DIR}/cmake/semfieldConfig.cmake.in ${PROJECT_BINARY_DIR}/semfieldConfig.cmake
                              INSTALL_DESTINATION ${semfield_package_dir} NO_SET_AND_CHECK_MACRO)
# Interfaces of a plugin may change with every minor version before 1.0; the loader's API number says so again at run time.
write_basic_package_version_file(${PROJECT_BINARY_DIR}/semfieldConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/semfieldConfig.cmake ${PROJECT_BINARY_DIR}/semfieldConfigVersion.cmake
              ${PROJECT_SOURCE_DIR}/cmake/KernelObjects.cmake ${PROJECT_SOURCE_DIR}/cmake/SemfieldPlugin.cmake
        DESTINATION ${semfield_package_dir} COMPONENT sdk)

foreach(command semfield_app semfield_cli)
  if(TARGET ${command})
    set_target_properties(${command} PROPERTIES INSTALL_RPATH "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
    install(TARGETS ${command} RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR} COMPONENT app)
  endif()
endforeach()
install(DIRECTORY ${PROJECT_SOURCE_DIR}/configs/ DESTINATION ${CMAKE_INSTALL_DATADIR}/semfield/configs COMPONENT app)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/bench/peers/ DESTINATION ${CMAKE_INSTALL_DATADIR}/semfield/bench/peers COMPONENT app)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/app/serve/page/ DESTINATION ${CMAKE_INSTALL_DATADIR}/semfield/app/serve/page COMPONENT app)
