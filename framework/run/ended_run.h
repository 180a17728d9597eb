// A run that has nothing left to train, score or write.
#pragma once

#include <optional>

#include "run/run_folder.h"
#include "run/run_resume.h"
#include "run/train_run.h"

namespace semfield {

/// What the run in `folder` came to, from its files, where the checkpoint that it goes on from is of its last step,
/// that step was scored, the page about it is there, and no setting changes; nothing is written. None: it has to be
/// gone on with, if only to be scored.
std::optional<TrainOutcome> ended_run(const RunFolder& folder, const RunConfig& config, const ResumePoint& point);

}  // namespace semfield
