// Files that come with the program and the library: configurations, scenes, pages.
#pragma once

#include <string>

namespace semfield {

/// The folder of shipped files, which holds configs/ and scenes/: what the environment variable SEMFIELD_SHARE names,
/// else share/semfield in a folder above the framework's library, which is the installed copy wherever its prefix was
/// moved to, or in a build folder a link to the source tree. "" where there is none. Throws Error(config) where
/// SEMFIELD_SHARE names no folder.
std::string shared_root();

/// Path of a shipped file or folder by its place in the source tree ("configs/paper.yaml"). Throws Error(no_input).
std::string shared_file(const std::string& relative);

}  // namespace semfield
