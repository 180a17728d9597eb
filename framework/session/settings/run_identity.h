// Which settings make a run the run that it is, and which may change while it goes on.
#pragma once

#include <string>
#include <string_view>

#include "config/explain.h"
#include "session/settings/run_config.h"

namespace semfield {

/// Not: a run's length, what it prints, measures and keeps beside the tensors, the machine's part in it (threads,
/// memory, device, who multiplies matrices), and where files lie.
bool is_part_of_identity(std::string_view key_path);
/// What is no part of the identity, and what helps a run over a step that failed: optimiser, schedule, seed, precision.
/// Everything else would make it another run.
bool may_change_on_resume(std::string_view key_path);

/// Equal for runs whose settings are the same but for those that are no part of the identity.
std::string identity_hash(const RunConfig& config);

/// Throws Error(no_input) naming the setting and `--set` when a place that run.yaml names for the scene or its label
/// files, but for clicks, is not there any more.
void require_scene_places(const RunConfig& config, const std::string& run_dir);

/// The text of run.yaml, which has been read back: Error(config) names what could never be read again, such as a
/// derived value beyond the range of its setting or a path that is no UTF-8.
std::string run_config_text(const RunConfig& config, Registry& registry);

}  // namespace semfield
