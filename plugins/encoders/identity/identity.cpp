// Parameters, traits and registration of the identity encoder.
#include "encoders/identity/identity.h"

#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

void describe(ParamVisitor&, IdentityParams&) {}

SEMFIELD_PLUGIN_MODULE(identity, "1.0", [](Registry& registry) {
  identity_kernels(registry.kernels());
  registry.add_encoder<Identity, IdentityParams>("identity", "Passes coordinates through unchanged.");
})

}  // namespace semfield
