// Group E: optimiser and precision.
#include "optimiser_cases.h"

namespace semfield::numerics {

namespace {

constexpr Case kCases[] = {
    {"E01", "adam-LD", "gradients 1e-20 .. 1e18, 1,000 steps", "long double", adam_sizes},
    {"E02", "adam-sparse", "a gradient every 1,000th step", "long double", adam_sparse},
    {"E03", "adam-eps", "epsilon 1e-15 and 1e-8, gradients 1e-9 .. 1e-22", "long double", adam_epsilon},
    {"E04", "zero-grad", "gradient 0 for 1,000 steps", "the same bits", adam_zero},
    {"E05", "nan-grad", "NaN and infinity in each tensor's gradient in turn", "the same bits", bad_gradient},
    {"E06", "loss-scale", "overflow every 5th step", "none", loss_scale},
    {"E07", "counters", "steps 1, 2^31, 2^53; learning rate at the end", "long double", counters},
    {"E08", "clip", "gradients of infinite and of zero norm", "the same bits", extreme_norms},
};

}  // namespace

std::span<const Case> optimiser_cases() { return kCases; }

}  // namespace semfield::numerics
