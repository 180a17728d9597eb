// The scenes that cells of a sweep share, packed.
#pragma once

#include <string>
#include <vector>

#include "app/sweep/sweep_folder.h"

namespace semfield::app {

/// Packs the scenes that cells share (Cell::pack) into FOLDER/scenes/, those that are not there yet or are damaged. One
/// process at a time does so; the others wait for it, and `note` says so.
void pack_scenes(const std::vector<Cell>& cells, const std::string& folder, Registry& registry, const SweepNote& note);

}  // namespace semfield::app
