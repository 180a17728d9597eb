// Photographs without camera poses: the commands that find poses for them.
#pragma once

#include <string>

namespace semfield::app {

/// The commands of COLMAP for the photographs in `folder`, or in a folder in it, and what to do then, several lines; ""
/// where there are fewer than three photographs.
std::string pose_commands(const std::string& folder);

}  // namespace semfield::app
