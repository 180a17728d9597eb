// `--time 90s` of the verbs that train.
#pragma once

#include <string>

namespace semfield::app {

/// The setting that `--time TEXT` is short for, as ConfigOptions::set takes it. Throws Error(usage) for what is no
/// positive time such as 90s, 5m or 1h.
std::string time_setting(const std::string& text);

}  // namespace semfield::app
