// The list `losses` of a configuration: chosen by type, read, written, and held against the scene.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "loading/frame_source.h"
#include "losses/loss_list.h"

namespace semfield {

/// The key `losses` of the tree; a type twice is an error.
std::vector<LossEntry> read_losses(const ConfigNode& tree, const Registry& registry, Diagnostics& diagnostics);
/// What read_losses would read, every parameter written out.
ConfigNode losses_config(const std::vector<LossEntry>& entries);

/// The targets that losses cannot do without, each once.
std::vector<std::string> targets_of(const std::vector<LossEntry>& entries);
/// True when one of them has the name.
bool losses_read(const std::vector<LossEntry>& entries, std::string_view target);
/// Depth images of training frames, and their valid pixels.
struct TrainingDepth {
  std::int64_t frames = 0, pixels = 0;
};
TrainingDepth training_depth(const LoadedScene& scene);
/// What training makes of them, as a phrase; "" where there are none and no term asks for them. Warns where a term
/// reads depth images without a valid pixel.
std::string depth_use(const std::vector<LossEntry>& entries, const TrainingDepth& depth, Diagnostics& diagnostics);

}  // namespace semfield
