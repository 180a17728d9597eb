// The arithmetic of matrix products.
#pragma once

#include <cstdint>

namespace semfield {

/// fp32: in the type of the operands (float64 in the oracle). bf16: operands and the activations between layers rounded
/// to bf16 (8 significant bits), products and sums in fp32; weights, their gradients and all else stay fp32. automatic:
/// a wish of settings alone, which the opening of a session turns into one of the two.
enum class Precision : std::uint8_t { fp32, bf16, automatic };

}  // namespace semfield
