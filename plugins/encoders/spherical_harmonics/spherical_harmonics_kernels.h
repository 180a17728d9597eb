// What the kernels of the spherical harmonics encoder know, and their formulas.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/view.h"
#include "plugin/row_encoder.h"

namespace semfield {

/// Most bands: l = 0 .. 4, 25 functions.
inline constexpr std::int32_t kHarmonicMaxDegree = 5;

/// N_lm at l (l + 1) / 2 + m, m >= 0.
template <class Real>
struct HarmonicNorms {
  Real n[kHarmonicMaxDegree * (kHarmonicMaxDegree + 1) / 2];
};

/// N_lm = sqrt((2 - [m = 0]) (2l + 1) / (4 pi) (l - m)! / (l + m)!), which makes the square of every function integrate
/// to 1.
template <class Real>
inline HarmonicNorms<Real> harmonic_norms() {
  constexpr double pi = 3.141592653589793;
  HarmonicNorms<Real> norms{};
  for (int l = 0; l < kHarmonicMaxDegree; ++l) {
    for (int m = 0; m <= l; ++m) {
      double ratio = 1;  // (l - m)! / (l + m)!
      for (int i = l - m + 1; i <= l + m; ++i) ratio /= i;
      norms.n[l * (l + 1) / 2 + m] =
          static_cast<Real>(std::sqrt((m == 0 ? 1.0 : 2.0) * (2 * l + 1) / (4 * pi) * ratio));
    }
  }
  return norms;
}

/// The factors that every function is made of. On the unit sphere the associated Legendre function P_l^m(z) is
/// (x^2 + y^2)^(m/2) Q_lm(z) with Q_lm = d^m P_l / dz^m, and (x^2 + y^2)^(m/2) e^(i m phi) = (x + i y)^m = A_m + i B_m;
/// so
///   Y_lm = N_lm Q_lm(z) A_m(x, y),  Y_l,-m = N_lm Q_lm(z) B_m(x, y),  m >= 0,
/// which is a polynomial: no angle and no pole. Differentiating Legendre's recurrence m times gives
///   (l - m) Q_lm = (2l - 1) z Q_l-1,m - (l + m - 1) Q_l-2,m,  Q_mm = (2m - 1)!!,  d Q_lm / dz = Q_l,m+1.
template <class Real>
struct HarmonicFactors {
  Real a[kHarmonicMaxDegree], b[kHarmonicMaxDegree];
  Real q[kHarmonicMaxDegree][kHarmonicMaxDegree + 1];  // q[l][m]; 0 for m > l
};

template <class Real>
SEMFIELD_HD inline void harmonic_factors(std::int32_t degree, Real x, Real y, Real z, HarmonicFactors<Real>& f) {
  f.a[0] = 1;
  f.b[0] = 0;
  for (std::int32_t m = 1; m < degree; ++m) {
    f.a[m] = x * f.a[m - 1] - y * f.b[m - 1];
    f.b[m] = x * f.b[m - 1] + y * f.a[m - 1];
  }
  Real double_factorial = 1;  // (2m - 1)!!
  for (std::int32_t m = 0; m < degree; ++m) {
    if (m > 0) double_factorial *= static_cast<Real>(2 * m - 1);
    for (std::int32_t l = 0; l < m; ++l) f.q[l][m] = 0;
    f.q[m][m] = double_factorial;
    for (std::int32_t l = m + 1; l < degree; ++l) {
      const Real before = l - 2 >= m ? f.q[l - 2][m] : Real(0);
      f.q[l][m] = (static_cast<Real>(2 * l - 1) * z * f.q[l - 1][m] - static_cast<Real>(l + m - 1) * before) /
                  static_cast<Real>(l - m);
    }
  }
  for (std::int32_t l = 0; l < degree; ++l) f.q[l][degree] = 0;
}

/// y[degree^2], column l^2 + l + m.
template <class Real>
SEMFIELD_HD inline void harmonics(const HarmonicNorms<Real>& norms, std::int32_t degree, const HarmonicFactors<Real>& f,
                                  Real* y) {
  for (std::int32_t l = 0; l < degree; ++l) {
    const std::int32_t middle = l * l + l;
    y[middle] = norms.n[l * (l + 1) / 2] * f.q[l][0];
    for (std::int32_t m = 1; m <= l; ++m) {
      const Real radial = norms.n[l * (l + 1) / 2 + m] * f.q[l][m];
      y[middle + m] = radial * f.a[m];
      y[middle - m] = radial * f.b[m];
    }
  }
}

/// dx[3] = sum over functions of dy dY/d(x, y, z); d(A_m + i B_m)/dx = m (A + i B)_(m-1), d/dy = i m (A + i B)_(m-1).
template <class Real>
SEMFIELD_HD inline void harmonics_gradient(const HarmonicNorms<Real>& norms, std::int32_t degree,
                                           const HarmonicFactors<Real>& f, const Real* dy, Real* dx) {
  dx[0] = dx[1] = dx[2] = 0;
  for (std::int32_t l = 0; l < degree; ++l) {
    const std::int32_t middle = l * l + l;
    dx[2] += dy[middle] * norms.n[l * (l + 1) / 2] * f.q[l][1];
    for (std::int32_t m = 1; m <= l; ++m) {
      const Real norm = norms.n[l * (l + 1) / 2 + m];
      const Real radial = norm * f.q[l][m] * static_cast<Real>(m);
      const Real d_cos = dy[middle + m];
      const Real d_sin = dy[middle - m];
      dx[0] += radial * (d_cos * f.a[m - 1] + d_sin * f.b[m - 1]);
      dx[1] += radial * (d_sin * f.a[m - 1] - d_cos * f.b[m - 1]);
      dx[2] += norm * f.q[l][m + 1] * (d_cos * f.a[m] + d_sin * f.b[m]);
    }
  }
}

/// Largest deviation of a direction's squared length from 1.
inline constexpr double kUnitTolerance = 1e-3;

/// f with the number of bands known to the compiler: the recurrences become straight code.
template <class F>
auto with_degree(std::int32_t degree, const F& f) {
  switch (degree) {
    case 1:
      return f.template operator()<1>();
    case 2:
      return f.template operator()<2>();
    case 3:
      return f.template operator()<3>();
    case 4:
      return f.template operator()<4>();
    default:
      return f.template operator()<5>();
  }
}

template <class Real>
struct HarmonicShape {
  std::int32_t degree = 4;
  HarmonicNorms<Real> norms = harmonic_norms<Real>();
};

void spherical_harmonics_kernels(KernelTables& tables);

}  // namespace semfield
