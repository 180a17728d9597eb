// Group C.
#include "stiff_case.h"

namespace semfield::stiff {

std::span<const Case> encoder_cases() { return {}; }

}  // namespace semfield::stiff
