// The report of a run: everything it shows comes from the run folder and the frames rendered last.
#pragma once

#include <string>

#include "run/report_frames.h"
#include "run/run_folder.h"
#include "session/session.h"

namespace semfield {

/// Writes report.html with its pictures and worst_frames.json into the folder; returns its path. `scene`:
/// ReportInput::scene.
std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames,
                             std::string scene = {});

}  // namespace semfield
