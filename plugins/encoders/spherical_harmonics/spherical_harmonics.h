// Real spherical harmonics of unit directions.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "encoders/spherical_harmonics/spherical_harmonics_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"

namespace semfield {

struct SphericalHarmonicsParams {
  int degree = 4;
};

void describe(ParamVisitor& visit, SphericalHarmonicsParams& params);

/// y [M, degree^2]: Y_lm at column l^2 + l + m, l = 0 .. degree-1, m = -l .. l; orthonormal over the sphere, without
/// the Condon-Shortley sign. x [M, 3] unit vectors: a squared length off 1 by more than 1e-3 (a zero vector, NaN) is
/// Error(data) naming the row. dx is the gradient of the polynomials of spherical_harmonics_kernels.h in x, y, z, not
/// its tangential part.
template <class Real>
class SphericalHarmonics final : public RowEncoder<Real, HarmonicShape<Real>> {
 public:
  SphericalHarmonics(const SphericalHarmonicsParams& params, const EncoderBuild& build, const KernelTables& kernels);

 protected:
  Error refused(View<const double> x, std::int64_t row) const override;
};

extern template class SphericalHarmonics<float>;
extern template class SphericalHarmonics<double>;

}  // namespace semfield
