# Warnings of our own code.
add_library(semfield_warnings INTERFACE)
target_compile_options(semfield_warnings INTERFACE -Wall -Wextra -Wpedantic -Wshadow -Wnon-virtual-dtor -Woverloaded-virtual)
