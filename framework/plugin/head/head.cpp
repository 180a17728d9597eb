#include "plugin/head/head.h"

#include "core/check.h"

namespace semfield {

template <class Real>
HiddenLayer<Real> Head<Real>::hidden_layer(const Tensors<Real>&) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was asked for its hidden layer");
  return {};
}

template <class Real>
void Head<Real>::rounded_hidden_forward(const StepContext&, const Tensors<Real>&, View<const Bf16>, View<Bf16>) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given some");
}

template <class Real>
void Head<Real>::rounded_hidden_backward(const StepContext&, const Tensors<Real>&, View<const Bf16>, View<const Bf16>,
                                         View<Bf16>) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given gradients of some");
}

template class Head<float>;
template class Head<double>;

}  // namespace semfield
