// Group I: the same numbers from every backend: the instruction sets that the CPU's kernels are compiled for, and the
// CUDA kernels where this build and machine have them.
#include "backend_parts.h"

namespace semfield::numerics {

namespace {

/// A case's rows on the processor, then those on a device.
template <void (*kHost)(CaseRun&), void (*kDevice)(CaseRun&)>
void both(CaseRun& run) {
  kHost(run);
  kDevice(run);
}

constexpr Case kCases[] = {
    {"I01", "min-max-nan", "NaN and infinity at every place of largest, ReLU, exp", "one rule on all",
     both<min_max_nan, nan_on_device>},
    {"I02", "fma", "kernels with and without fused multiply-adds", "the generic set",
     both<fused_or_not, fused_on_device>},
    {"I03", "ftz", "subnormal numbers, flushing to zero off and on", "long double",
     both<flush_to_zero, subnormals_on_device>},
    {"I04", "ulp-table", "exp, expm1, sigmoid, softplus, sin on every instruction set", "long double",
     both<ulp_table, sines_on_device>},
    {"I05", "index-31-bits", "matrices whose elements lie beyond 2^31", "the same, packed",
     both<long_index, long_index_on_device>},
    {"I06", "whole-step", "a step and 100 steps on every instruction set, in bf16, on 1 and 3 threads",
     "float64; generic", both<whole_step, whole_step_on_device>},
    {"I07", "finite-checks", "a NaN in front of every guard of the shipped build", "seen",
     both<finite_checks, finite_checks_on_device>},
};

}  // namespace

std::span<const Case> backend_cases() { return kCases; }

}  // namespace semfield::numerics
