// Sine and cosine by short polynomials on an eighth of a turn, and their reduction from quarters of a turn.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/host_device.h"

namespace semfield {

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

/// sin and cos of `quarters` pi/2. Branch-free: loops over it vectorise.
template <class Real>
SEMFIELD_HD inline void sincos_of_quarters(double quarters, Real& sine, Real& cosine) {
  constexpr double half_pi = 1.5707963267948966;
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
