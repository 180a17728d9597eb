#include "plugin/head/one_layer_head.h"

#include <cmath>

namespace semfield {

template <class Real>
OneLayerHead<Real>::OneLayerHead(const HeadShape& shape, const HeadKernels<Real>& kernels)
    : shape_(shape), kernels_(&kernels) {
  const Init hidden_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.feature)));
  const Init output_init = Init::uniform(1 / std::sqrt(static_cast<double>(shape.hidden)));
  specs_.push_back({"hidden/weight", shape.feature, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({"hidden/bias", 1, shape.hidden, hidden_init, TensorRole::dense});
  specs_.push_back({shape.output + "/weight", shape.hidden, shape.width, output_init, TensorRole::dense});
  specs_.push_back({shape.output + "/bias", 1, shape.width, output_init, TensorRole::dense});
  if (kernels.derive == nullptr) return;
  shape_.hidden_weight = rearranged_weight(specs_, kHiddenWeight, 0, shape.feature, shape.precision);
  shape_.output_weight = rearranged_weight(specs_, kOutputWeight, 0, shape.hidden, Precision::fp32);
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
void OneLayerHead<Real>::output_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                                        View<const Real> opacity, View<Real> rows) const {
  if (h.rows > 0) kernels_->output_forward(shape_, *ctx.workspace, tensors, h, opacity, rows);
}

template <class Real>
void OneLayerHead<Real>::output_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                                         View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                                         View<Real> d_opacity) const {
  if (h.rows > 0) kernels_->output_backward(shape_, *ctx.workspace, tensors, h, opacity, d_rows, d_h, d_opacity);
}

template class OneLayerHead<float>;
template class OneLayerHead<double>;

}  // namespace semfield
