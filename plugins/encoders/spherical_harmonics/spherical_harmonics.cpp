// Real spherical harmonics of unit directions.
#include <string>

#include "config/params.h"
#include "core/check.h"
#include "core/error.h"
#include "encoders/spherical_harmonics/spherical_harmonics_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

struct SphericalHarmonicsParams {
  int degree = 4;
};

/// y [M, degree^2]: Y_lm at column l^2 + l + m, l = 0 .. degree-1, m = -l .. l; orthonormal over the sphere, without
/// the Condon-Shortley sign. x [M, 3] unit vectors: a squared length off 1 by more than 1e-3 (a zero vector, NaN) is
/// Error(data) naming the row. dx is the gradient of the polynomials of spherical_harmonics_kernels.h in x, y, z, not
/// its tangential part.
template <class Real>
class SphericalHarmonics final : public RowEncoder<Real, HarmonicShape<Real>> {
 public:
  SphericalHarmonics(const SphericalHarmonicsParams& p, const EncoderBuild& build, const KernelTables& kernels)
      : RowEncoder<Real, HarmonicShape<Real>>(build, kernels, "encoder 'spherical_harmonics'",
                                              {3, p.degree * p.degree, Domain::direction}, {p.degree}) {
    SEMFIELD_CHECK(p.degree >= 1 && p.degree <= kHarmonicMaxDegree, "the range is checked while reading");
  }

 protected:
  Error refused(View<const double> x, std::int64_t row) const override {
    const std::string vector = x.device == Device::cpu
                                   ? " (" + std::to_string(x(row, 0)) + ", " + std::to_string(x(row, 1)) + ", " +
                                         std::to_string(x(row, 2)) + ")"
                                   : "";
    return {ErrorKind::data, "scene.direction.length",
            "encoder 'spherical_harmonics': row " + std::to_string(row) + " is not a unit vector" + vector,
            "this encoder is for view directions; use frequency or hash_grid for positions"};
  }
};

void describe(ParamVisitor& visit, SphericalHarmonicsParams& p) {
  SEMFIELD_PARAM(visit, p, degree, "number of bands l = 0 .. degree-1, giving degree^2 functions",
                 {1, kHarmonicMaxDegree});
}

SEMFIELD_PLUGIN_MODULE(spherical_harmonics, "1.0", [](Registry& registry) {
  spherical_harmonics_kernels(registry.kernels());
  registry.add_encoder<SphericalHarmonics, SphericalHarmonicsParams>(
      "spherical_harmonics", "Real orthonormal spherical harmonics of view directions.");
})

}  // namespace semfield
