// Half precision: a float in two bytes.
#pragma once

#include <cstdint>

namespace semfield {

/// IEEE 754 binary16, round to nearest even; overflow gives infinity, NaN stays NaN.
std::uint16_t half_of(float value);
float float_of_half(std::uint16_t half);

// A bfloat16 as memory holds it: the upper 16 bits of a float.

/// Arithmetic is the device's own; the framework only makes room for such numbers and hands them on.
struct Bf16 {
  std::uint16_t bits;
};

}  // namespace semfield
