// The widest floating type at hand for references: 113 bits where the compiler has them, else long double.
#pragma once

#include <cmath>

#if defined(SEMFIELD_HAS_QUADMATH)
#include <quadmath.h>
#endif

namespace semfield::numerics {

#if defined(SEMFIELD_HAS_QUADMATH)
__extension__ using Wide = __float128;
inline Wide wide_sin(Wide x) { return sinq(x); }
inline Wide wide_cos(Wide x) { return cosq(x); }
inline Wide wide_scaled(Wide x, int exponent) { return ldexpq(x, exponent); }
inline Wide wide_remainder(Wide x, Wide y) { return fmodq(x, y); }
inline Wide wide_pi() { return 4 * atanq(1); }
#else
using Wide = long double;
inline Wide wide_sin(Wide x) { return std::sin(x); }
inline Wide wide_cos(Wide x) { return std::cos(x); }
inline Wide wide_scaled(Wide x, int exponent) { return std::ldexp(x, exponent); }
inline Wide wide_remainder(Wide x, Wide y) { return std::fmod(x, y); }
inline Wide wide_pi() { return 3.14159265358979323846264338327950288L; }
#endif

inline double distance(Wide a, Wide b) { return static_cast<double>(a > b ? a - b : b - a); }

}  // namespace semfield::numerics
