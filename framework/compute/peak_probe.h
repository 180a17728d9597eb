// What this machine can do at most, measured: multiply-adds from registers, and random reads.
#pragma once

#include <cstddef>

namespace semfield {

/// Floating-point operations a second (a multiply-add counts 2) of independent float chains held in registers, over
/// `threads` threads, each running for about `seconds`. Uses the widest vectors that the processor has, whatever the
/// build was compiled for: it is the machine's limit, not the build's.
double peak_fp32_flops(int threads, double seconds);

/// The same for products of bfloat16 pairs added in float (vdpbf16ps); 0 where the processor has none.
double peak_bf16_flops(int threads, double seconds);

/// Reads a second of 8-byte words at random places of a table of `bytes` (rounded down to a power of two, one table
/// shared by the threads); addresses do not depend on what was read.
double random_reads(int threads, std::size_t bytes, double seconds);

}  // namespace semfield
