// Parameters, traits and registration of the spherical harmonics encoder.
#include "encoders/spherical_harmonics/spherical_harmonics.h"

#include <string>

#include "core/check.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor& visit, SphericalHarmonicsParams& p) {
  SEMFIELD_PARAM(visit, p, degree, "number of bands l = 0 .. degree-1, giving degree^2 functions",
                 {1, kHarmonicMaxDegree});
}

template <class Real>
SphericalHarmonics<Real>::SphericalHarmonics(const SphericalHarmonicsParams& p, const EncoderBuild& build,
                                             const KernelTables& kernels)
    : RowEncoder<Real, HarmonicShape<Real>>(build, kernels, "encoder 'spherical_harmonics'",
                                            {3, p.degree * p.degree, Domain::direction}, {p.degree}) {
  SEMFIELD_CHECK(p.degree >= 1 && p.degree <= kHarmonicMaxDegree, "the range is checked while reading");
}

template <class Real>
Error SphericalHarmonics<Real>::refused(View<const double> x, std::int64_t row) const {
  const std::string vector =
      x.device == Device::cpu
          ? " (" + std::to_string(x(row, 0)) + ", " + std::to_string(x(row, 1)) + ", " + std::to_string(x(row, 2)) + ")"
          : "";
  return {ErrorKind::data, "scene.direction.length",
          "encoder 'spherical_harmonics': row " + std::to_string(row) + " is not a unit vector" + vector,
          "this encoder is for view directions; use frequency or hash_grid for positions"};
}

template class SphericalHarmonics<float>;
template class SphericalHarmonics<double>;

SEMFIELD_PLUGIN_MODULE(spherical_harmonics, "1.0", [](Registry& registry) {
  spherical_harmonics_kernels(registry.kernels());
  registry.add_encoder<SphericalHarmonics, SphericalHarmonicsParams>(
      "spherical_harmonics", "Real orthonormal spherical harmonics of view directions.");
})

}  // namespace semfield
