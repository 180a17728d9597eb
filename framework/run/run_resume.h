// What a resumed run goes on from: its newest checkpoint, and the settings that it may and may not change.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "config/explain.h"
#include "run/run_folder.h"
#include "session/checkpoint_facts.h"
#include "session/session.h"
#include "session/settings/run_config.h"

namespace semfield {

struct ResumePoint {
  std::optional<CheckpointFacts> facts;   ///< of the newest checkpoint that verifies; none: the run begins at step 0
  std::string path;                       ///< of that checkpoint
  std::vector<ConfigDifference> changed;  ///< settings that are others than before, and may be
  std::int64_t step() const { return facts ? facts->step : 0; }
};

/// Compares `config` with what the checkpoint was trained with, or with run.yaml where there is none. Throws
/// Error(config) naming every setting that would make it another run, Error(data) for a bad checkpoint.
ResumePoint find_resume_point(const RunFolder& folder, const RunConfig& config, Registry& registry,
                              Diagnostics& diagnostics);

/// None when a program of another version wrote them and they cannot be read.
std::optional<RunConfig> settings_of_checkpoint(const CheckpointFacts& facts, Registry& registry);

/// Warns of other inputs, labels and modules than the checkpoint's; Error(data) where classes have changed places.
void compare_with_training(const CheckpointFacts& facts, const SceneInputs& inputs, const Session& session,
                           Diagnostics& diagnostics);

/// For a run that is looked at by `config`, its run.yaml with `overrides`: throws Error(config) naming each setting of
/// the run's identity that run.yaml says otherwise than the checkpoint, and notes those that `overrides` say otherwise.
/// False where they name other frames, sizes or bounds than those of training: then other inputs are no news.
bool compare_settings_with_training(const CheckpointFacts& facts, const RunConfig& config, const RunFolder& folder,
                                    const std::vector<std::string>& overrides, Registry& registry,
                                    Diagnostics& diagnostics);

}  // namespace semfield
