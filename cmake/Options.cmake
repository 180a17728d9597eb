# Build options, in one place.
set(CMAKE_CXX_STANDARD 20)
set(CMAKE_CXX_STANDARD_REQUIRED ON)
set(CMAKE_CXX_EXTENSIONS OFF)
set(CMAKE_EXPORT_COMPILE_COMMANDS ON)
set(CMAKE_POSITION_INDEPENDENT_CODE ON)
set(CMAKE_CXX_VISIBILITY_PRESET default)
if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
  set(CMAKE_BUILD_TYPE Release CACHE STRING "Build type" FORCE)
endif()

option(SEMFIELD_WITH_IMAGES "Read images through OpenImageIO; off: packed scenes only" ON)
option(SEMFIELD_WITH_RAYCAST "Ray-cast OBJ rooms with Embree and tinyobjloader" ON)
option(SEMFIELD_WITH_SERVE "The labelling page, `semfield serve`: JPEG by TurboJPEG" ON)
set(SEMFIELD_WITH_PYTHON AUTO CACHE STRING "The Python module: ON, OFF, or AUTO = where pybind11 and Python's headers are found")
set(SEMFIELD_PYTHON_DIR lib/python3/dist-packages CACHE STRING "Where the Python module is installed, below the prefix")
set(SEMFIELD_WITH_CUDA AUTO CACHE STRING "Kernels for NVIDIA GPUs: ON, OFF, or AUTO = where this machine has an NVIDIA device and a CUDA compiler, for that device alone")
set(SEMFIELD_WITH_MPI AUTO CACHE STRING "Runs over several processes by MPI: ON, OFF, or AUTO = where MPI is found")
set(SEMFIELD_WITH_NCCL AUTO CACHE STRING "Gradients of several GPUs meet by NCCL: ON, OFF, or AUTO = where it is found (NCCL_INCLUDE_DIR and NCCL_LIBRARY name another)")
set(SEMFIELD_CUDA_ARCHITECTURES "" CACHE STRING "What CUDA kernels are compiled for; empty: with AUTO the devices of this machine, with ON 80-real;90a-real;90-virtual. -virtual: PTX, which newer chips compile when a program starts")
set(SEMFIELD_EXTRA_PARTS "" CACHE STRING "Folders of parts that are built in as if they lay in this tree: plugins/KIND/NAME")
option(SEMFIELD_BUILD_FUZZERS "Build the fuzzers of tests/fuzz (clang only; see the preset fuzz and scripts/fuzz)" OFF)
set(SEMFIELD_MARCH "" CACHE STRING "-march of the whole build, for one machine, e.g. native; empty: any machine, kernels by SEMFIELD_ISAS")
set(SEMFIELD_SANITIZE "" CACHE STRING "Sanitizers, e.g. address,undefined or thread; empty: none")

find_program(SEMFIELD_CCACHE ccache)
if(SEMFIELD_CCACHE AND NOT CMAKE_CXX_COMPILER_LAUNCHER)
  set(CMAKE_CXX_COMPILER_LAUNCHER ${SEMFIELD_CCACHE})
  set(CMAKE_CUDA_COMPILER_LAUNCHER ${SEMFIELD_CCACHE})
endif()

# Fast math stays banned: it deletes the finite checks. Contraction to FMA is allowed, and is the same in a loop's vector body and tail.
add_compile_options("$<$<COMPILE_LANGUAGE:CXX>:-ffp-contract=fast;-fno-math-errno;-fno-trapping-math>")
if(SEMFIELD_MARCH)
  add_compile_options(-march=${SEMFIELD_MARCH})
endif()
if(SEMFIELD_SANITIZE)
  add_compile_options(-fsanitize=${SEMFIELD_SANITIZE} -fno-omit-frame-pointer -fno-sanitize-recover=all)
  add_link_options(-fsanitize=${SEMFIELD_SANITIZE})
endif()
if(SEMFIELD_BUILD_FUZZERS)
  if(NOT CMAKE_CXX_COMPILER_ID MATCHES "Clang")
    message(FATAL_ERROR "SEMFIELD_BUILD_FUZZERS needs clang, which brings libFuzzer; this is ${CMAKE_CXX_COMPILER_ID}: cmake --preset fuzz")
  endif()
  add_compile_options(-fsanitize=fuzzer-no-link)
endif()
set(CMAKE_CXX_FLAGS_RELEASE "-O3")

# Warnings of our own code.
add_library(semfield_warnings INTERFACE)
target_compile_options(semfield_warnings INTERFACE "$<$<COMPILE_LANGUAGE:CXX>:-Wall;-Wextra;-Wpedantic;-Wshadow;-Wnon-virtual-dtor;-Woverloaded-virtual>"
                       "$<$<COMPILE_LANGUAGE:CUDA>:-Xcompiler=-Wall,-Wextra>")
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 13)
  # g++ 12 warns inside its own headers: of AVX-512, about values that those leave undefined on purpose, and of strings, about
  # an overlap in `"text" + string` that cannot be (GCC bug 105651, mended in 13).
  target_compile_options(semfield_warnings INTERFACE "$<$<COMPILE_LANGUAGE:CXX>:-Wno-maybe-uninitialized;-Wno-uninitialized;-Wno-restrict>")
endif()

# Of code that reads, checks, writes and says, and loops over no pixels or samples: -O1 takes a third less time to compile than -O3.
add_library(semfield_light INTERFACE)
target_compile_options(semfield_light INTERFACE "$<$<AND:$<CONFIG:Release>,$<COMPILE_LANGUAGE:CXX>>:-O1>")
