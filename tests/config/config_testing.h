// What the tests of configs share: the message of a refusal, files in a folder of their own.
#pragma once

#include <unistd.h>

#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {

/// What the Error(config) says that `body` throws; "" when it throws nothing.
inline std::string refusal(const std::function<void()>& body) { return error_of(ErrorKind::config, body); }

}  // namespace semfield
