// a b + c with the same bits in every loop.
#pragma once

#include <cmath>

#include "compute/isa.h"

namespace semfield::SEMFIELD_ISA {

/// a b + c, fused wherever the machine can. Spelled out: left to contraction, which of two products is fused may differ
/// from loop to loop and from lane to lane, and then an element's bits would depend on the place that it fell into.
template <class Real>
inline Real multiply_add(Real a, Real b, Real c) {
#if defined(__FMA__)
  return std::fma(a, b, c);
#else
  return a * b + c;
#endif
}

}  // namespace semfield::SEMFIELD_ISA
