// The file of a loadable module, looked at before any of its code runs.
#pragma once

#include <map>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

/// Throws Error(unavailable), begun with `doing`, for a file that is no shared library of this processor, that ends
/// before what it says must be mapped, that has no section kPluginSection, or whose API number or ABI tag are not ours.
void check_module_file(const std::string& path, const std::string& doing);

/// Name and checksum of each of these files, which hold plugins. Throws Error(no_input).
std::map<std::string, std::string> module_checksums(const std::vector<std::string>& files);

/// A warning for each of `files` that is another one than in `trained`, by name; a name that is not there is no news.
void warn_of_other_modules(const std::map<std::string, std::string>& trained, const std::vector<std::string>& files,
                           Diagnostics& diagnostics);

}  // namespace semfield
