# Warnings of our own code.
add_library(semfield_warnings INTERFACE)
target_compile_options(semfield_warnings INTERFACE "$<$<COMPILE_LANGUAGE:CXX>:-Wall;-Wextra;-Wpedantic;-Wshadow;-Wnon-virtual-dtor;-Woverloaded-virtual>"
                       "$<$<COMPILE_LANGUAGE:CUDA>:-Xcompiler=-Wall,-Wextra>")
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 13)
  # g++ 12 warns inside its own headers: of AVX-512, about values that those leave undefined on purpose, and of strings, about
  # an overlap in `"text" + string` that cannot be (GCC bug 105651, mended in 13).
  target_compile_options(semfield_warnings INTERFACE "$<$<COMPILE_LANGUAGE:CXX>:-Wno-maybe-uninitialized;-Wno-uninitialized;-Wno-restrict>")
endif()
