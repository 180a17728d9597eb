// The largest size of a number in a matrix, from which sums in fixed point take their unit.
#pragma once

#include <cstdint>

#include "core/view.h"

namespace semfield::cuda {

/// *largest = the larger of itself and the bits of the largest |value| of the rows in use (launch().live_rows); those
/// of a NaN are larger than any number's. Device memory; the order does not matter, so matrices may be looked at beside
/// each other.
void find_largest(View<const float> values, std::uint32_t* largest);

}  // namespace semfield::cuda
