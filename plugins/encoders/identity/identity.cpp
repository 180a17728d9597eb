// The encoder that passes coordinates through: y = x.
#include "config/params.h"
#include "encoders/identity/identity_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"
#include "plugin/module.h"
#include "plugin/registry.h"

namespace semfield {

struct IdentityParams {};

/// y [M, in_dims] = x, rounded to Real. Throws Error(data) for a coordinate that is not finite.
template <class Real>
class Identity final : public RowEncoder<Real, IdentityShape> {
 public:
  Identity(const IdentityParams&, const EncoderBuild& build, const KernelTables& kernels)
      : RowEncoder<Real, IdentityShape>(build, kernels, "encoder 'identity'",
                                        {build.in_dims, build.in_dims, Domain::metric}, {}) {}
};

void describe(ParamVisitor&, IdentityParams&) {}

SEMFIELD_PLUGIN_MODULE(identity, "1.0", [](Registry& registry) {
  identity_kernels(registry.kernels());
  registry.add_encoder<Identity, IdentityParams>("identity", "Passes coordinates through unchanged.");
})

}  // namespace semfield
