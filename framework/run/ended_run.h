// A run that has nothing left to train, score or write.
#pragma once

#include <optional>
#include <string>

#include "run/train_run.h"

namespace semfield {

/// What the run in `run_dir` came to, from its files, where its newest checkpoint is of its last step, that step was
/// scored, the page about it is there, and `config` changes no setting; nothing is written. None: it has to be gone on
/// with, if only to be scored. Throws as find_resume_point does.
std::optional<TrainOutcome> ended_run(const RunConfig& config, Registry& registry, const std::string& run_dir);

}  // namespace semfield
