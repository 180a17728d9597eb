// One rendered view as panels side by side: what a frame of a video shows.
#pragma once

#include <string>
#include <vector>

#include "eval/evaluator.h"
#include "session/session.h"

namespace semfield::app {

enum class Panel : std::uint8_t { rgb, label, depth, entropy };

/// By panel.
const std::vector<std::string>& panel_names();
/// Of names that are in panel_names(); of none: all that the run has. Throws Error(usage) for label or entropy of a run
/// without semantics.
std::vector<Panel> panels_of(const std::vector<std::string>& names, bool semantics);

/// Colour; classes half over colour; depth and entropy in the house's colours over a range that is the same for every
/// frame of the run (near to far, 0 to ln K). [H * panels W * 3]
std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<Panel>& panels, const Session& s);

}  // namespace semfield::app
