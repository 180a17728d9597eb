// The only file that tests for the CUDA compiler: formulas marked SEMFIELD_HD compile for host and device alike.
#pragma once

#ifdef __CUDACC__
#define SEMFIELD_HD __host__ __device__
#else
#define SEMFIELD_HD
#endif
