// Findings as people read them.
#pragma once

#include <vector>

#include "core/error.h"

namespace semfield {

/// What is shown of `diagnostics`: findings that say the same of several places are one, the first, whose last words
/// count and name the others. The same is what differs in nothing but paths and numbers.
std::vector<Diagnostic> folded(const Diagnostics& diagnostics);

}  // namespace semfield
