// The encoder that passes coordinates through: y = x.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "encoders/identity/identity_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"

namespace semfield {

struct IdentityParams {};

void describe(ParamVisitor& visit, IdentityParams& params);

/// y [M, in_dims] = x, rounded to Real. Throws Error(data) for a coordinate that is not finite.
template <class Real>
class Identity final : public RowEncoder<Real, IdentityShape> {
 public:
  Identity(const IdentityParams&, const EncoderBuild& build, const KernelTables& kernels)
      : RowEncoder<Real, IdentityShape>(build, kernels, "encoder 'identity'",
                                        {build.in_dims, build.in_dims, Domain::metric}, {}) {}
};

}  // namespace semfield
