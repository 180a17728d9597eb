// A bfloat16 as memory holds it: the upper 16 bits of a float.
#pragma once

#include <cstdint>

namespace semfield {

/// Arithmetic is the device's own; the framework only makes room for such numbers and hands them on.
struct Bf16 {
  std::uint16_t bits;
};

}  // namespace semfield
