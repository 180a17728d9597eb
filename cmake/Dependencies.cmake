# Every find_package call of the project.
find_package(Threads REQUIRED)
find_package(OpenMP REQUIRED COMPONENTS CXX)
find_package(Eigen3 3.4 REQUIRED NO_MODULE)
find_package(yaml-cpp REQUIRED)
find_package(fmt REQUIRED)
find_package(nlohmann_json REQUIRED)
find_package(CLI11 REQUIRED)
find_package(ZLIB REQUIRED)
if(SEMFIELD_WITH_IMAGES)
  # Debian's package configuration of OpenImageIO names command line tools of another package and stops without them, so
  # header and library are looked for directly.
  find_path(SEMFIELD_OPENIMAGEIO_INCLUDE OpenImageIO/imageio.h REQUIRED)
  find_library(SEMFIELD_OPENIMAGEIO_LIBRARY OpenImageIO REQUIRED)
  find_library(SEMFIELD_OPENIMAGEIO_UTIL_LIBRARY OpenImageIO_Util REQUIRED)
  if(NOT TARGET OpenImageIO::OpenImageIO)
    add_library(OpenImageIO::OpenImageIO UNKNOWN IMPORTED)
    set_target_properties(OpenImageIO::OpenImageIO PROPERTIES IMPORTED_LOCATION ${SEMFIELD_OPENIMAGEIO_LIBRARY}
                          INTERFACE_INCLUDE_DIRECTORIES ${SEMFIELD_OPENIMAGEIO_INCLUDE}
                          INTERFACE_LINK_LIBRARIES ${SEMFIELD_OPENIMAGEIO_UTIL_LIBRARY})
  endif()
endif()
if(SEMFIELD_WITH_RAYCAST)
  find_package(embree 3 REQUIRED)
  find_package(tinyobjloader REQUIRED)
endif()
if(BUILD_TESTING OR NOT DEFINED BUILD_TESTING)
  find_package(GTest REQUIRED)
endif()
