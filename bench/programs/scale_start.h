// `semfield`, which lies beside this program, started as ranks of mpirun for the study `scale`.
#pragma once

#include <string>

#include "app/app_context.h"
#include "studies/scale_bench.h"

namespace semfield::app {

/// Throws Error(unavailable) naming the package where mpirun is missing.
void need_mpirun();

/// Starts the program, its output in `folder`, and waits for its end. A stop signal goes on to it and ends the study.
/// Throws as need_mpirun() where there are several ranks, and Error(failure) for a process that does not end.
ScaleEnd start_ranks(const ScaleStart& start, const std::string& folder, const AppContext& context);

}  // namespace semfield::app
