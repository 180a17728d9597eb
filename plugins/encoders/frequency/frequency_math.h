// Formulas of the frequency encoder: exact phase in turns, then short polynomials of sine and cosine.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

namespace semfield {

/// Meaning of the angle: sin(2^k x) (radian) or sin(2^k pi x) (pi).
enum class Angular : std::uint8_t { radian, pi };

/// What is rounded to fp32 before a phase is reduced. float64: nothing. float32: the coordinate, the reduction stays
/// exact. naive: the coordinate, the factor a 2^k and their product, as sin(float) of a plain fp32 program has them.
enum class Arithmetic : std::uint8_t { float64, float32, naive };

/// Coordinates farther out are refused: no scene has them, and they would only hide a broken pose.
inline constexpr double kFrequencyLimit = 1073741824.0;  // 2^30

/// A phase in turns (1 turn = 2 pi rad) as an unevaluated sum hi + lo.
struct Turns {
  double hi, lo;
};

/// Phase of band 0. radian: x / (2 pi) with 1 / (2 pi) = c0 + c1 kept to 107 bits; pi: x / 2, exact.
SEMFIELD_HD inline Turns turns_of(double x, Angular angular) {
  constexpr double c0 = 0x1.45f306dc9c883p-3;
  constexpr double c1 = -0x1.6b01ec5417056p-57;
  if (angular == Angular::pi) return {0.5 * x, 0.0};
  const double hi = x * c0;
  return {hi, std::fma(x, c0, -hi) + x * c1};
}

/// Phase of band k where everything is rounded to fp32: the angle fl(fl(a 2^k) fl(x)) in radians; `factor` = a 2^k.
SEMFIELD_HD inline Turns naive_turns_of(double x, double factor) {
  return turns_of(static_cast<double>(static_cast<float>(factor) * static_cast<float>(x)), Angular::radian);
}

/// sin z on [-pi/4, pi/4]: Taylor polynomial whose first dropped term is below a quarter of Real's last bit.
SEMFIELD_HD inline float sine_near_zero(float z) {
  const float s = z * z;
  const float p = -1.f / 6 + s * (1.f / 120 + s * (-1.f / 5040 + s * (1.f / 362880)));
  return z + z * (s * p);
}
SEMFIELD_HD inline double sine_near_zero(double z) {
  const double s = z * z;
  double p = 1.0 / 355687428096000;
  p = -1.0 / 1307674368000 + s * p;
  p = 1.0 / 6227020800 + s * p;
  p = -1.0 / 39916800 + s * p;
  p = 1.0 / 362880 + s * p;
  p = -1.0 / 5040 + s * p;
  p = 1.0 / 120 + s * p;
  p = -1.0 / 6 + s * p;
  return z + z * (s * p);
}

/// cos z on [-pi/4, pi/4], likewise.
SEMFIELD_HD inline float cosine_near_zero(float z) {
  const float s = z * z;
  const float p = 1.f / 24 + s * (-1.f / 720 + s * (1.f / 40320 + s * (-1.f / 3628800)));
  return 1.f + s * (-0.5f + s * p);
}
SEMFIELD_HD inline double cosine_near_zero(double z) {
  const double s = z * z;
  double p = -1.0 / 6402373705728000;
  p = 1.0 / 20922789888000 + s * p;
  p = -1.0 / 87178291200 + s * p;
  p = 1.0 / 479001600 + s * p;
  p = -1.0 / 3628800 + s * p;
  p = 1.0 / 40320 + s * p;
  p = -1.0 / 720 + s * p;
  p = 1.0 / 24 + s * p;
  return 1.0 + s * (-0.5 + s * p);
}

/// sin and cos of 2 pi 2^k phase, `scale` = 2^k. Scaling by a power of two and subtracting the nearest whole turn are
/// both exact, so no band loses accuracy: 2 pi t = z + q pi/2 with whole q and |z| <= pi/4. Branch-free: loops over it
/// vectorise.
template <class Real>
SEMFIELD_HD inline void sincos_of_turns(Turns phase, double scale, Real& sine, Real& cosine) {
  constexpr double half_pi = 1.5707963267948966;
  double a = phase.hi * scale;
  a -= std::rint(a);
  double b = phase.lo * scale;
  b -= std::rint(b);
  const double quarters = 4.0 * (a + b);
  const double nearest = std::rint(quarters);
  const auto z = static_cast<Real>((quarters - nearest) * half_pi);
  const auto q = static_cast<std::int32_t>(nearest);
  const Real s = sine_near_zero(z);
  const Real c = cosine_near_zero(z);
  const Real s_turned = (q & 1) != 0 ? c : s;
  const Real c_turned = (q & 1) != 0 ? s : c;
  sine = (q & 2) != 0 ? -s_turned : s_turned;
  cosine = ((q + 1) & 2) != 0 ? -c_turned : c_turned;
}

}  // namespace semfield
