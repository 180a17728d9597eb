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
void validate(const IdentityParams& params, Diagnostics& diagnostics);

/// y [M, in_dims] = x, rounded to Real. Throws Error(data) for a coordinate that is not finite.
template <class Real>
class Identity final : public Encoder<Real> {
 public:
  Identity(const IdentityParams& params, const EncoderBuild& build, const KernelTables& kernels);
  EncoderTraits traits() const noexcept override;

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                  View<Real> y) const override;
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                   View<Real> dx) const override;

 private:
  const IdentityKernels<Real>* kernels_;
  std::int32_t dims_;
};

extern template class Identity<float>;
extern template class Identity<double>;

}  // namespace semfield
