// Parameters, traits and registration of the identity encoder.
#include "encoders/identity/identity.h"

#include <string>

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor&, IdentityParams&) {}
void validate(const IdentityParams&, Diagnostics&) {}

template <class Real>
Identity<Real>::Identity(const IdentityParams&, const EncoderBuild& build, const KernelTables& kernels)
    : kernels_(&kernels.get<IdentityKernels<Real>>(build.device, "encoder 'identity'")), dims_(build.in_dims) {}

template <class Real>
EncoderTraits Identity<Real>::traits() const noexcept {
  return {dims_, dims_, Domain::metric};
}

template <class Real>
void Identity<Real>::do_forward(const StepContext&, const Tensors<Real>&, View<const double> x, View<Real> y) const {
  const std::int64_t bad = kernels_->forward(x, y);
  if (bad >= 0) {
    throw Error(ErrorKind::data, "scene.coordinates.not_finite",
                "encoder 'identity': coordinate of row " + std::to_string(bad) + " is not finite",
                "check the camera poses and the ray limits");
  }
}

template <class Real>
void Identity<Real>::do_backward(const StepContext&, const Tensors<Real>&, View<const double>, View<const Real> dy,
                                 View<Real> dx) const {
  if (!dx.empty()) kernels_->backward(dy, dx);
}

template class Identity<float>;
template class Identity<double>;

SEMFIELD_PLUGIN_MODULE(identity, "1.0", [](Registry& registry) {
  identity_kernels(registry.kernels());
  registry.add_encoder<Identity, IdentityParams>("identity", "Passes coordinates through unchanged.");
})

}  // namespace semfield
