// Programs of others, found as a shell finds them.
#pragma once

#include <string>

namespace semfield::app {

/// File of the first program of that name in the folders of PATH; "" where there is none.
std::string program_in_path(const std::string& name);

}  // namespace semfield::app
