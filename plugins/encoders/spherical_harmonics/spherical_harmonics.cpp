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

void validate(const SphericalHarmonicsParams&, Diagnostics&) {}

template <class Real>
SphericalHarmonics<Real>::SphericalHarmonics(const SphericalHarmonicsParams& params, const EncoderBuild& build,
                                             const KernelTables& kernels)
    : kernels_(&kernels.get<SphericalHarmonicsKernels<Real>>(build.device, "encoder 'spherical_harmonics'")),
      degree_(params.degree),
      norms_(harmonic_norms<Real>()) {
  if (build.in_dims != 3) {
    throw Error(ErrorKind::config, "config.encoder.inputs",
                "encoder 'spherical_harmonics' takes 3 coordinates, got " + std::to_string(build.in_dims));
  }
  SEMFIELD_CHECK(degree_ >= 1 && degree_ <= kHarmonicMaxDegree, "the range is checked while reading");
}

template <class Real>
EncoderTraits SphericalHarmonics<Real>::traits() const noexcept {
  return {3, degree_ * degree_, Domain::direction};
}

template <class Real>
void SphericalHarmonics<Real>::do_forward(const StepContext&, const Tensors<Real>&, View<const double> x,
                                          View<Real> y) const {
  const std::int64_t bad = kernels_->forward(norms_, degree_, x, y);
  if (bad >= 0) {
    const std::string vector = x.device == Device::cpu
                                   ? " (" + std::to_string(x(bad, 0)) + ", " + std::to_string(x(bad, 1)) + ", " +
                                         std::to_string(x(bad, 2)) + ")"
                                   : "";
    throw Error(ErrorKind::data, "scene.direction.length",
                "encoder 'spherical_harmonics': row " + std::to_string(bad) + " is not a unit vector" + vector,
                "this encoder is for view directions; use frequency or hash_grid for positions");
  }
}

template <class Real>
void SphericalHarmonics<Real>::do_backward(const StepContext&, const Tensors<Real>&, View<const double> x,
                                           View<const Real> dy, View<Real> dx) const {
  if (!dx.empty()) kernels_->backward(norms_, degree_, x, dy, dx);
}

template class SphericalHarmonics<float>;
template class SphericalHarmonics<double>;

SEMFIELD_PLUGIN_MODULE(spherical_harmonics, "1.0", [](Registry& registry) {
  spherical_harmonics_kernels(registry.kernels());
  registry.add_encoder<SphericalHarmonics, SphericalHarmonicsParams>(
      "spherical_harmonics", "Real orthonormal spherical harmonics of view directions.");
})

}  // namespace semfield
