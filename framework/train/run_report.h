// The report of a run: everything it shows comes from the run folder and the frames rendered last.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "train/run_folder.h"
#include "train/session.h"

namespace semfield {

/// Writes report.html into the folder; returns its path. `strips`: frames with their maps, in the order shown.
std::string write_run_report(const RunFolder& folder, const Session& session,
                             const std::vector<std::pair<int, RenderedFrame>>& strips);

}  // namespace semfield
