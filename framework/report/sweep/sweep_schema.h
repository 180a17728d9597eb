// A JSON schema of sweep files, for editors.
#pragma once

#include <string>

namespace semfield {

/// Draft 7, indented by two spaces; it refuses the keys that read_sweep refuses.
std::string sweep_schema();

}  // namespace semfield
