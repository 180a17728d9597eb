// Parameters, traits and registration of the spherical harmonics encoder.
#include "encoders/spherical_harmonics/spherical_harmonics.h"

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

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
