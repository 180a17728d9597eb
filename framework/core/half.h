// Numbers in two bytes, and the arithmetic of matrix products.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

namespace semfield {

/// IEEE 754 binary16, round to nearest even; overflow gives infinity, NaN stays NaN.
inline std::uint16_t half_of(float value) {
  const auto bits = std::bit_cast<std::uint32_t>(value);
  const auto sign = static_cast<std::uint16_t>((bits >> 16) & 0x8000u);
  const std::uint32_t magnitude = bits & 0x7FFFFFFFu;
  if (magnitude > 0x7F800000u) return static_cast<std::uint16_t>(sign | 0x7E00u);
  if (magnitude >= 0x477FF000u) return static_cast<std::uint16_t>(sign | 0x7C00u);  // rounds to 65536 or more
  if (magnitude < 0x38800000u) {  // below 2^-14: multiples of 2^-24, rounded by the float adder
    const float scaled = std::bit_cast<float>(magnitude) * 0x1p24F;
    return static_cast<std::uint16_t>(sign | static_cast<std::uint16_t>(std::nearbyint(scaled)));
  }
  const std::uint32_t rounded = magnitude + 0xFFFu + ((magnitude >> 13) & 1u);
  return static_cast<std::uint16_t>(sign | ((rounded - 0x38000000u) >> 13));
}

inline float float_of_half(std::uint16_t half) {
  const std::uint32_t sign = (half & 0x8000u) << 16;
  const std::uint32_t exponent = (half >> 10) & 0x1Fu, mantissa = half & 0x3FFu;
  if (exponent == 0) {
    const float value = static_cast<float>(mantissa) * 0x1p-24F;
    return sign != 0 ? -value : value;
  }
  if (exponent == 31) return std::bit_cast<float>(sign | 0x7F800000u | (mantissa << 13));
  return std::bit_cast<float>(sign | ((exponent + 112) << 23) | (mantissa << 13));
}

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
