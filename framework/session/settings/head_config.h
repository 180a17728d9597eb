// The list `heads` of a configuration: read, written, and held against losses and scene.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "loading/frame_source.h"
#include "session/settings/run_config.h"

namespace semfield {

/// The key `heads` of the tree. A channel twice is an error, and so is one that the framework makes itself.
std::vector<HeadConfig> read_heads(const ConfigNode& tree, const Registry& registry, Diagnostics& diagnostics);
/// What read_heads would read, every parameter written out.
ConfigNode heads_config(const std::vector<HeadConfig>& heads);
/// An error for each loss that reads a channel which no head makes.
void check_heads_of_losses(const RunConfig& config, Diagnostics& diagnostics);

/// Columns of a head whose dataset has more for its channel, unless its own `width` says otherwise.
inline constexpr int kUsualHeadWidth = 64;
/// Settles width and source_width of the heads by the channels of the scene's training frames. Throws Error(config) for
/// a head whose width neither says, and for one that is to have more columns than its channel; Error(data) for a
/// channel whose frames differ in columns.
void settle_heads(RunConfig& config, const SceneInfo& scene);

}  // namespace semfield
