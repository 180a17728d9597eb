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
OneLayerHead<Real>::OneLayerHead(const HeadShape& shape, const HeadKernels<Real>& kernels)
    : shape_(shape), kernels_(&kernels) {
  const Init hidden_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.feature)));
  const Init class_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.hidden)));
  specs_.push_back({"hidden/weight", shape.feature, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({"hidden/bias", 1, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({"class/weight", shape.hidden, shape.classes, class_init, TensorRole::dense});
  specs_.push_back({"class/bias", 1, shape.classes, class_init, TensorRole::dense});
  if (kernels.derive == nullptr) return;
  shape_.hidden_weight = rearranged_weight(specs_, kHiddenWeight, 0, shape.feature, shape.precision);
  shape_.class_weight = rearranged_weight(specs_, kClassWeight, 0, shape.hidden, Precision::fp32);
}

template <class Real>
void OneLayerHead<Real>::declare(ParamDeclarer& declarer) const {
  for (const TensorSpec& spec : specs_) declarer.tensor(spec);
}

template <class Real>
void OneLayerHead<Real>::derive(const StepContext&, const Tensors<Real>& tensors) const {
  if (kernels_->derive != nullptr) kernels_->derive(shape_, tensors);
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
  if (feature.rows > 0) kernels_->rounded_hidden_forward(shape_, *ctx.workspace, tensors, feature, hidden);
}

template <class Real>
void OneLayerHead<Real>::rounded_hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors,
                                                 View<const Bf16> feature, View<const Bf16> d_hidden,
                                                 View<Bf16> d_feature) const {
  if (feature.rows > 0)
    kernels_->rounded_hidden_backward(shape_, *ctx.workspace, tensors, feature, d_hidden, d_feature);
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
