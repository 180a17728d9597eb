// Half precision: a float in two bytes.
#pragma once

#include <cstdint>

namespace semfield {

/// IEEE 754 binary16, round to nearest even; overflow gives infinity, NaN stays NaN.
std::uint16_t half_of(float value);
float float_of_half(std::uint16_t half);

}  // namespace semfield
