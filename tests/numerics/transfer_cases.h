// The cases of group A by file, and the smooth problem that several of them solve.
#pragma once

#include "ray_bench.h"

namespace semfield::numerics {

// transfer_cases.cpp: closed forms.
// transfer_convergence_cases.cpp: orders, walls, slabs.
void exp_sigma(CaseRun& run);
void gauss_bump(CaseRun& run);
void linear_colour(CaseRun& run);
void order_smooth(CaseRun& run);
void stiff_wall(CaseRun& run);
void onset_between(CaseRun& run);
void thin_slab(CaseRun& run);
// transfer_gradient_cases.cpp: the way back.
void grad_depth_of_fog(CaseRun& run);
void grad_opaque(CaseRun& run);
void grad_all_outputs(CaseRun& run);
// transfer_limit_cases.cpp: early stop, bad values, subnormal numbers, units.
void early_stop(CaseRun& run);
void bad_density(CaseRun& run);
void denormal(CaseRun& run);
void split_invariance(CaseRun& run);
void inf_delta(CaseRun& run);
void nonunit_dirs(CaseRun& run);

}  // namespace semfield::numerics
