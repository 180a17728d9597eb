// What the kernels of the frequency encoder know, and their formulas.
#pragma once

#include <cmath>
#include <cstdint>

#include "compute/math_functions.h"
#include "core/view.h"
#include "plugin/row_encoder.h"

namespace semfield {

/// Meaning of the angle: sin(2^k x) (radian) or sin(2^k pi x) (pi).
enum class Angular : std::uint8_t { radian, pi };

/// Factor of x in the angle of band 0.
SEMFIELD_HD inline double angular_factor(Angular angular) { return angular == Angular::pi ? 3.141592653589793 : 1.0; }

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

/// sin and cos of 2 pi 2^k phase, `scale` = 2^k. Scaling by a power of two and subtracting the nearest whole turn are
/// both exact, so no band loses accuracy. Branch-free: loops over it vectorise.
template <class Real>
SEMFIELD_HD inline void sincos_of_turns(Turns phase, double scale, Real& sine, Real& cosine) {
  double a = phase.hi * scale;
  a -= std::rint(a);
  double b = phase.lo * scale;
  b -= std::rint(b);
  sincos_of_quarters(4.0 * (a + b), sine, cosine);
}

struct FrequencyShape {
  std::int32_t dims = 3;
  std::int32_t frequencies = 10;
  bool include_input = true;
  Angular angular = Angular::radian;
  Arithmetic arithmetic = Arithmetic::float64;
};

/// Most coordinates of an input row.
inline constexpr std::int32_t kFrequencyMaxDims = 16;

void frequency_kernels(KernelTables& tables);

}  // namespace semfield
