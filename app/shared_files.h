// Files that come with the program: configurations and scripts.
#pragma once

#include <string>

namespace semfield::app {

/// Path of a shipped file by its place in the source tree ("configs/paper.yaml"): under share/semfield beside the
/// program's own folder, which is the installed copy, or in a build folder a link to the source tree. Throws
/// Error(no_input).
std::string shared_file(const std::string& relative);

}  // namespace semfield::app
