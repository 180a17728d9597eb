// The list `losses` of a configuration: terms chosen by type, read, written, documented, and held against the scene.
#pragma once

#include <string>
#include <vector>

#include "config/config_tree.h"
#include "config/params_read.h"
#include "losses/loss_list.h"
#include "scene/scene.h"

namespace semfield {

/// The key `losses` of the tree; a type twice is an error.
std::vector<LossEntry> read_losses(const ConfigNode& tree, Diagnostics& diagnostics);
/// What read_losses would read, every parameter written out.
ConfigNode losses_config(const std::vector<LossEntry>& entries);

/// An error for each term whose data no training frame has.
void require_loss_data(const std::vector<LossEntry>& entries, const SceneInfo& scene, Diagnostics& diagnostics);
/// True when a term reads the depth of training frames.
bool losses_read_depth(const std::vector<LossEntry>& entries);

/// Every type that the list may name.
struct LossDoc {
  std::string type, sentence;
  std::vector<ParamDoc> params;
};
std::vector<LossDoc> describe_losses();

}  // namespace semfield
