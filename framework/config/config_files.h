// Configurations by name: files of the user's, then those that come with the program.
#pragma once

#include <string>

namespace semfield {

/// The shipped configuration that a relative name means: `quickstart`, `quickstart.yaml` and `configs/quickstart.yaml`
/// are one. "" where there is none.
std::string shipped_config(const std::string& name);

/// Where shipped_config looks for a file of exactly this name, for messages; "" for an absolute one, and where nothing
/// is shipped.
std::string shipped_place(const std::string& name);

/// The name of the configuration nearest to one that is not there, next to `own_place`, where it was looked for, or
/// among the shipped ones; "" when none is near.
std::string near_config(const std::string& name, const std::string& own_place);

/// The file that a name on the command line means: as it is written, then with .yaml behind it, then a shipped one.
/// Throws Error(no_input) with the places and the nearest name.
std::string find_config(const std::string& name);

}  // namespace semfield
