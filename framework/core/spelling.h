// Names that were meant: known names near a misspelt one.
#pragma once

#include <string>
#include <string_view>
#include <vector>

namespace semfield {

/// As did_you_mean (core/error.h), by edit distance alone: for names that share their parts.
std::string closest_spelling(std::string_view word, const std::vector<std::string>& known);

}  // namespace semfield
