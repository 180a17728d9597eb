// The view in 3D at the top of a report.
#pragma once

#include <cstdint>
#include <string>

#include "app/app_context.h"
#include "session/session.h"

namespace semfield::app {

/// ReportInput::scene of a run that has come to `step`: the page of a coarse mesh. As evaluation does, it keeps to a
/// tenth of the training: of its rays here. "" where those are too few to see a surface, and where there is none or it
/// cannot be shown, which a note says.
std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context);

}  // namespace semfield::app
