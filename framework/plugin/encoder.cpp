// Checked entry points of every encoder.
#include "plugin/encoder.h"

#include "plugin/reference.h"

namespace semfield {

template <class Real>
void Encoder<Real>::forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                            View<Real> y) const {
  constexpr const char* kCall = "encoder.forward";
  const EncoderTraits shape = traits();
  view_checks::require(kCall, "x", x, x.rows, shape.in_dims, x.device);
  view_checks::require(kCall, "y", y, x.rows, shape.out_dims, x.device);
  if (x.rows > 0) do_forward(ctx, tensors, x, y);
}

template <class Real>
void Encoder<Real>::backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                             View<const Real> dy, View<Real> dx) const {
  constexpr const char* kCall = "encoder.backward";
  const EncoderTraits shape = traits();
  view_checks::require(kCall, "x", x, x.rows, shape.in_dims, x.device);
  view_checks::require(kCall, "dy", dy, x.rows, shape.out_dims, x.device);
  view_checks::require_or_empty(kCall, "dx", dx, x.rows, shape.in_dims, x.device);
  const bool dx_alone = tensors.grad.empty() && !dx.empty();
  if (!dx_alone && tensors.grad.size() != tensors.value.size())
    view_checks::fail(kCall, "the tensors have no gradients");
  if (x.rows > 0) do_backward(ctx, tensors, x, dy, dx);
}

template class Encoder<float>;
template class Encoder<double>;

}  // namespace semfield
