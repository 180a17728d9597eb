#include "model/semantic_head.h"

#include <cmath>

#include "core/check.h"

namespace semfield {

template <class Real>
HiddenLayer<Real> SemanticHead<Real>::hidden_layer(const Tensors<Real>&) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was asked for its hidden layer");
  return {};
}

template <class Real>
void SemanticHead<Real>::rounded_hidden_forward(const StepContext&, const Tensors<Real>&, View<const Bf16>,
                                                View<Bf16>) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given some");
}

template <class Real>
void SemanticHead<Real>::rounded_hidden_backward(const StepContext&, const Tensors<Real>&, View<const Bf16>,
                                                 View<const Bf16>, View<Bf16>) const {
  SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given gradients of some");
}

template <class Real>
void OneLayerHead<Real>::declare(ParamDeclarer& declarer) const {
  const HeadShape& s = shape_;
  const Init hidden_init = Init::uniform(1 / std::sqrt(static_cast<double>(s.feature)));
  const Init class_init = Init::uniform(1 / std::sqrt(static_cast<double>(s.hidden)));
  declarer.tensor({"hidden/weight", s.feature, s.hidden, hidden_init, TensorRole::dense});
  declarer.tensor({"hidden/bias", 1, s.hidden, hidden_init, TensorRole::dense});
  declarer.tensor({"class/weight", s.hidden, s.classes, class_init, TensorRole::dense});
  declarer.tensor({"class/bias", 1, s.classes, class_init, TensorRole::dense});
  declarer.tensor({"hidden/weight_t", s.hidden, s.feature, {}, TensorRole::derived, false});
  declarer.tensor({"class/weight_t", s.classes, s.hidden, {}, TensorRole::derived, false});
}

template <class Real>
void OneLayerHead<Real>::derive(const StepContext&, const Tensors<Real>& tensors) const {
  if (kernels_->derive != nullptr) kernels_->derive(tensors);
}

template <class Real>
HiddenLayer<Real> OneLayerHead<Real>::hidden_layer(const Tensors<Real>& tensors) const {
  HiddenLayer<Real> layer;
  layer.weight = tensors.value[kHiddenWeight];
  layer.bias = tensors.value[kHiddenBias];
  if (tensors.grad.empty()) return layer;
  layer.d_weight = tensors.grad[kHiddenWeight];
  layer.d_bias = tensors.grad[kHiddenBias];
  return layer;
}

template <class Real>
void OneLayerHead<Real>::hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                                        View<Real> hidden) const {
  if (feature.rows > 0) kernels_->hidden_forward(shape_, *ctx.workspace, tensors, feature, hidden);
}

template <class Real>
void OneLayerHead<Real>::hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                                         View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const {
  if (feature.rows > 0)
    kernels_->hidden_backward(shape_, *ctx.workspace, tensors, feature, hidden, d_hidden, d_feature);
}

template <class Real>
void OneLayerHead<Real>::rounded_hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors,
                                                View<const Bf16> feature, View<Bf16> hidden) const {
  if (feature.rows > 0) kernels_->rounded_hidden_forward(*ctx.workspace, tensors, feature, hidden);
}

template <class Real>
void OneLayerHead<Real>::rounded_hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors,
                                                 View<const Bf16> feature, View<const Bf16> d_hidden,
                                                 View<Bf16> d_feature) const {
  if (feature.rows > 0) kernels_->rounded_hidden_backward(*ctx.workspace, tensors, feature, d_hidden, d_feature);
}

template <class Real>
void OneLayerHead<Real>::class_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                                       View<const Real> share, View<Real> logits) const {
  if (h.rows > 0) kernels_->class_forward(shape_, *ctx.workspace, tensors, h, share, logits);
}

template <class Real>
void OneLayerHead<Real>::class_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                                        View<const Real> share, View<const Real> d_logits, View<Real> d_h,
                                        View<Real> d_share) const {
  if (h.rows > 0) kernels_->class_backward(shape_, *ctx.workspace, tensors, h, share, d_logits, d_h, d_share);
}

template class SemanticHead<float>;
template class SemanticHead<double>;
template class OneLayerHead<float>;
template class OneLayerHead<double>;

}  // namespace semfield
