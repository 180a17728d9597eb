// The semantic head on the processor.
#include "model/head_kernels.h"

#include "compute/linear.h"

namespace semfield {

namespace {

template <class Real>
void derive(const Tensors<Real>& tensors) {
  transpose<Real>(tensors.value[kHiddenWeight], tensors.value[kHiddenWeightT]);
  transpose<Real>(tensors.value[kClassWeight], tensors.value[kClassWeightT]);
}

template <class Real>
void hidden_forward(const HeadShape& shape, Workspace&, const Tensors<Real>& tensors, View<const Real> feature,
                    View<Real> hidden) {
  linear_forward<Real>(feature, tensors.value[kHiddenWeight], tensors.value[kHiddenBias], Activation::relu, hidden,
                       shape.precision);
}

template <class Real>
void hidden_backward(const HeadShape& shape, Workspace&, const Tensors<Real>& tensors, View<const Real> feature,
                     View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) {
  LinearGrad<Real> grad;
  grad.weight_t = tensors.value[kHiddenWeightT];
  grad.d_weight = tensors.grad[kHiddenWeight];
  grad.d_bias = tensors.grad[kHiddenBias];
  grad.dx = d_feature;
  grad.precision = shape.precision;
  linear_backward<Real>(Activation::relu, feature, hidden, d_hidden, grad);
}

template <class Real>
void class_forward(const HeadShape&, Workspace&, const Tensors<Real>& tensors, View<const Real> h,
                   View<const Real> share, View<Real> logits) {
  const View<const Real> bias = tensors.value[kClassBias];
  if (share.empty()) {
    linear_forward<Real>(h, tensors.value[kClassWeight], bias, Activation::none, logits);
    return;
  }
  gemm<Real>(share, bias, logits);
  linear_forward_add<Real>(h, tensors.value[kClassWeight], Activation::none, logits);
}

template <class Real>
void class_backward(const HeadShape& shape, Workspace&, const Tensors<Real>& tensors, View<const Real> h,
                    View<const Real> share, View<const Real> d_logits, View<Real> d_h, View<Real> d_share) {
  LinearGrad<Real> grad;
  grad.weight_t = tensors.value[kClassWeightT];
  grad.d_weight = tensors.grad[kClassWeight];
  grad.d_bias = share.empty() ? tensors.grad[kClassBias] : View<Real>();
  grad.dx = d_h;
  linear_backward<Real>(h, d_logits, grad);
  if (share.empty()) return;
  gemm_at_b_add<Real>(share, d_logits, tensors.grad[kClassBias]);
  if (d_share.empty()) return;
  const View<Real> bias = tensors.value[kClassBias];
  gemm<Real>(d_logits, View<const Real>(bias.data, shape.classes, 1), d_share);
}

}  // namespace

template <class Real>
const HeadKernels<Real>& processor_head_kernels() {
  static constexpr HeadKernels<Real> kernels{
      derive<Real>, hidden_forward<Real>, hidden_backward<Real>, class_forward<Real>, class_backward<Real>, nullptr,
      nullptr};
  return kernels;
}

template const HeadKernels<float>& processor_head_kernels<float>();
template const HeadKernels<double>& processor_head_kernels<double>();

}  // namespace semfield
