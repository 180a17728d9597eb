# Debian packages by CPack: `semfield` (program and libraries), `libsemfield-dev`, and `python3-semfield` where the build has the component
# python. docs/decisions.md, 0021, says why these; the preset is `package`. Nothing where
# dpkg-shlibdeps is missing (package dpkg-dev).
find_program(SEMFIELD_SHLIBDEPS dpkg-shlibdeps)
if(NOT SEMFIELD_SHLIBDEPS)
  return()
endif()
set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGE_NAME semfield)
set(CPACK_PACKAGE_CONTACT "Semfield maintainers <maintainers@users.noreply.semfield.example>" CACHE STRING "Maintainer of the packages, as Debian writes one")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "")  # each package has a synopsis of its own
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_STRIP_FILES ON)
set(CPACK_INSTALL_DEFAULT_DIRECTORY_PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE GROUP_READ GROUP_EXECUTE WORLD_READ WORLD_EXECUTE)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_RELEASE 1)
set(CPACK_DEBIAN_PACKAGE_SOURCE semfield)
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION ON)
set(CPACK_DEBIAN_COMPRESSION_TYPE xz)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)  # of each package, by dpkg-shlibdeps; our own libraries are found in the build
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS_PRIVATE_DIRS ${PROJECT_BINARY_DIR}/framework ${PROJECT_BINARY_DIR}/plugins)
set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_COMPONENTS_GROUPING ONE_PER_GROUP)
set(semfield_deb_version ${PROJECT_VERSION}-${CPACK_DEBIAN_PACKAGE_RELEASE})

set(CPACK_DEBIAN_PROGRAM_PACKAGE_NAME semfield)
set(CPACK_DEBIAN_PROGRAM_PACKAGE_SECTION science)
set(CPACK_DEBIAN_PROGRAM_PACKAGE_SUGGESTS "colmap, ffmpeg, libsemfield-dev, python3-semfield")
if(SEMFIELD_MPI)
  string(APPEND CPACK_DEBIAN_PROGRAM_PACKAGE_SUGGESTS ", openmpi-bin")
endif()
set(CPACK_DEBIAN_PROGRAM_DESCRIPTION "labelled 3D scenes from posed images and a few 2D labels
Semfield trains a neural field of appearance, geometry and semantics from
posed images of one scene. It renders colour, depth, class labels and their
uncertainty for any view, and writes the labelled surface as a mesh.
\n`semfield demo` shows all of it on a room that is shipped.")

set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_NAME libsemfield-dev)
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_DEPENDS "semfield (= ${semfield_deb_version})")
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_SUGGESTS "cmake, g++")
set(CPACK_DEBIAN_DEVELOPMENT_DESCRIPTION "headers and CMake package of Semfield
What a plugin of Semfield is built with: the headers of the framework, the
kit of laws that test a plugin, and a CMake package, which
find_package(semfield) finds. Programs that drive a training need it too.")

set(CPACK_DEBIAN_MODULE_PACKAGE_NAME python3-semfield)
set(CPACK_DEBIAN_MODULE_PACKAGE_SECTION python)
if(SEMFIELD_PYTHON)  # the extension is of one version of Python
  math(EXPR semfield_next_python "${Python_VERSION_MINOR} + 1")
  set(CPACK_DEBIAN_MODULE_PACKAGE_DEPENDS "semfield (= ${semfield_deb_version}), python3 (>= ${Python_VERSION_MAJOR}.${Python_VERSION_MINOR}), \
python3 (<< ${Python_VERSION_MAJOR}.${semfield_next_python}), python3-numpy")
endif()
set(CPACK_DEBIAN_MODULE_PACKAGE_CONTROL_EXTRA ${PROJECT_SOURCE_DIR}/packaging/debian/python3-semfield/postinst
    ${PROJECT_SOURCE_DIR}/packaging/debian/python3-semfield/prerm)
set(CPACK_DEBIAN_MODULE_DESCRIPTION "Python module of Semfield
`import semfield` opens, trains, evaluates and renders semantic neural fields
step by step. Images, depth and class probabilities are NumPy arrays.")

# What each package holds: components of cmake --install, and the files that Debian asks of every package.
set(semfield_deb_files ${PROJECT_BINARY_DIR}/packaging)
configure_file(${PROJECT_SOURCE_DIR}/packaging/debian/changelog.in ${semfield_deb_files}/changelog.Debian @ONLY)
execute_process(COMMAND gzip -9nkf ${semfield_deb_files}/changelog.Debian COMMAND_ERROR_IS_FATAL ANY)
set(semfield_deb_program runtime app)
set(semfield_deb_development sdk)
set(semfield_deb_module python)
get_cmake_property(semfield_components COMPONENTS)
foreach(group program development module)
  string(TOUPPER ${group} upper)
  list(GET semfield_deb_${group} 0 first)
  if(NOT first IN_LIST semfield_components)  # a build without Python has no component python
    continue()
  endif()
  set(package ${CPACK_DEBIAN_${upper}_PACKAGE_NAME})
  file(WRITE ${semfield_deb_files}/${package}.overrides
       "# These packages are made for people, not for Debian's archive: there is no report that asked for them.\n${package}: initial-upload-closes-no-bugs *\n")
  install(FILES ${semfield_deb_files}/${package}.overrides DESTINATION ${CMAKE_INSTALL_DATADIR}/lintian/overrides RENAME ${package}
          COMPONENT ${group}_documents EXCLUDE_FROM_ALL)
  install(FILES ${PROJECT_SOURCE_DIR}/packaging/debian/copyright ${semfield_deb_files}/changelog.Debian.gz
          DESTINATION ${CMAKE_INSTALL_DATADIR}/doc/${package} COMPONENT ${group}_documents EXCLUDE_FROM_ALL)
  foreach(component ${semfield_deb_${group}} ${group}_documents)
    string(TOUPPER ${component} upper)
    set(CPACK_COMPONENT_${upper}_GROUP ${group})
    list(APPEND CPACK_COMPONENTS_ALL ${component})
  endforeach()
endforeach()
include(CPack)
