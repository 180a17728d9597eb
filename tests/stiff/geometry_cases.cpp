// Group F.
#include "stiff_case.h"

namespace semfield::stiff {

std::span<const Case> geometry_cases() { return {}; }

}  // namespace semfield::stiff
