// What the files of group F give its list of cases.
#pragma once

#include "named_case.h"

namespace semfield::numerics {

void box_on_face(CaseRun& run);
void box_parallel_outside(CaseRun& run);
void box_every_place(CaseRun& run);
void box_thin(CaseRun& run);
void quaternion_scales(CaseRun& run);
void rotation_check(CaseRun& run);
void rotation_between(CaseRun& run);
void bad_pose(CaseRun& run);
void intrinsics(CaseRun& run);
void far_origin(CaseRun& run);
void slivers(CaseRun& run);
void bad_meshes(CaseRun& run);

}  // namespace semfield::numerics
