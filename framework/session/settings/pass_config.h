// Passes of a configuration: plugin slots read from the tree, and written back.
#pragma once

#include <string>
#include <vector>

#include "session/settings/run_config.h"

namespace semfield {

/// The plugin that `node` names under 'type', with its parameters; `other_keys` of the map belong to others. Findings
/// go to `diagnostics`, and the slot is then of no use.
PluginSlot read_slot(PluginKind kind, const ConfigNode& node, const std::string& path, const Registry& registry,
                     Diagnostics& diagnostics, const std::vector<std::string>& other_keys = {});
/// The keys `position` and `field` of a branch; false where `node` is no map.
bool read_branch_slots(const ConfigNode& node, const std::string& path, const Registry& registry, PluginSlot& position,
                       PluginSlot& field, Diagnostics& diagnostics);
/// The section `passes`.
void read_passes(const ConfigNode& tree, const Registry& registry, RunConfig& config, Diagnostics& diagnostics);

/// {type, every parameter}.
ConfigNode typed_config(const std::string& type, const Describe& describe);
/// What read_slot and read_passes would read, every parameter written out.
ConfigNode slot_config(const PluginSlot& slot);
ConfigNode pass_config(const PassConfig& pass);

}  // namespace semfield
