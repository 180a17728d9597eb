// The functions of group E's cases.
#pragma once

#include "named_case.h"

namespace semfield::numerics {

// adam_cases.cpp
void adam_sizes(CaseRun& run);
void adam_sparse(CaseRun& run);
void adam_epsilon(CaseRun& run);
void adam_zero(CaseRun& run);
void counters(CaseRun& run);
// gradient_guard_cases.cpp
void bad_gradient(CaseRun& run);
void loss_scale(CaseRun& run);
void extreme_norms(CaseRun& run);

}  // namespace semfield::numerics
