// The file of a loadable module, looked at before any of its code runs.
#pragma once

#include <string>

namespace semfield {

/// Throws Error(unavailable), begun with `doing`, for a file that is no shared library of this processor, that ends
/// before what it says must be mapped, that has no section kPluginSection, or whose API number or ABI tag are not ours.
void check_module_file(const std::string& path, const std::string& doing);

}  // namespace semfield
