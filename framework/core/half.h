// Numbers in two bytes, and the arithmetic of matrix products.
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

/// fp32: in the type of the operands (float64 in the oracle). bf16: operands and the activations between layers rounded
/// to bf16 (8 significant bits), products and sums in fp32; weights, their gradients and all else stay fp32. automatic:
/// a wish of settings alone, which the opening of a session turns into one of the two.
enum class Precision : std::uint8_t { fp32, bf16, automatic };

}  // namespace semfield

