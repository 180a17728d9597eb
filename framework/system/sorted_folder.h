// What lies in a folder, in the order of names: file systems each have an order of their own.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

namespace semfield {

/// Entries of `folder`, by name. Throws Error(no_input) for a folder that cannot be read.
std::vector<std::filesystem::directory_entry> sorted_folder(const std::string& folder);

}  // namespace semfield
