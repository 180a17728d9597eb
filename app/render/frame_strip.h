// One rendered view as panels side by side: what a frame of a video shows.
#pragma once

#include <string>
#include <vector>

#include "eval/evaluator.h"
#include "session/session.h"

namespace semfield::app {

enum class Panel : std::uint8_t { rgb, label, depth, entropy };

/// "rgb,label" to panels; "": all that the run has. Throws Error(usage) for an unknown name, and for label or
/// entropy of a run without semantics.
std::vector<Panel> parse_panels(const std::string& names, bool semantics);

/// Colour; classes half over colour; depth and entropy in the house's colours over a range that is the same for every
/// frame of the run (near to far, 0 to ln K). [H * panels W * 3]
std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<Panel>& panels, const Session& s);

}  // namespace semfield::app
