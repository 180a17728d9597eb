// The only file that tests for the CUDA compiler: formulas marked SEMFIELD_HD compile for host and device alike.
#pragma once

#ifdef __CUDACC__
#define SEMFIELD_HD __host__ __device__
#elif defined(SEMFIELD_KERNEL_FILE)
// Compiled once per instruction set: no copy of a formula may be shared with other files (compute/isa.h).
#define SEMFIELD_HD __attribute__((always_inline))
#else
#define SEMFIELD_HD
#endif
