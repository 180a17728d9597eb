// `--time 90s` and `--steps N` of the verbs that train.
#pragma once

#include <optional>
#include <string>

#include "app/verb.h"
#include "session/settings/choices.h"

namespace semfield::app {

struct LengthWords {
  std::string time;  ///< "90s", "5m", "1h"
  std::optional<long long> steps;
};

/// Declares both, of which a command line has one.
void declare_length(VerbWords& verb, LengthWords& words);
/// Throws Error(usage) for what is no positive time such as 90s, 5m or 1h.
AskedLength asked_length(const LengthWords& words);

}  // namespace semfield::app
