// Group I: the same numbers from every backend. Kernels for the GPU do not exist; what is compared are the instruction
// sets that the CPU's kernels are compiled for.
#include "backend_parts.h"

namespace semfield::stiff {

namespace {

constexpr Case kCases[] = {
    {"I01", "min-max-nan", "NaN and infinity at every place of largest, ReLU, exp", "one rule on all", min_max_nan},
    {"I02", "fma", "kernels with and without fused multiply-adds", "the generic set", fused_or_not},
    {"I03", "ftz", "subnormal numbers, flushing to zero off and on", "long double", flush_to_zero},
    {"I04", "ulp-table", "exp, expm1, sigmoid, softplus, sin on every instruction set", "long double", ulp_table},
    {"I05", "index-31-bits", "matrices whose elements lie beyond 2^31", "the same, packed", long_index},
    {"I06", "whole-step", "a step and 100 steps on every instruction set, in bf16, on 1 and 3 threads",
     "float64; generic", whole_step},
    {"I07", "finite-checks", "a NaN in front of every guard of the shipped build", "seen", finite_checks},
};

}  // namespace

std::span<const Case> backend_cases() { return kCases; }

}  // namespace semfield::stiff
