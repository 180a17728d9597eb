// The fixed semantic head: position-only feature -> hidden (ReLU) -> class logits, with the class layer deferred to
// once a ray.
#pragma once

#include "model/head_kernels.h"
#include "plugin/field.h"

namespace semfield {

/// S(r) = W2 (sum_k w_k h_k) + b2 sum_k w_k: the class layer and compositing are both linear, so the hidden activations
/// are composited and the class layer is applied once a ray [Zhi21, Eq. 6 with linearity]. The head sees no view
/// direction: its only input is the field's position-only feature.
template <class Real>
class SemanticHead final : public Parametric<Real> {
 public:
  /// `kernels` must live as long as the head.
  explicit SemanticHead(const HeadShape& shape, const HeadKernels<Real>& kernels = processor_head_kernels<Real>())
      : shape_(shape), kernels_(&kernels) {}

  std::int32_t hidden_width() const { return shape_.hidden; }
  std::int32_t classes() const { return shape_.classes; }
  /// Whether it takes a feature in bf16, or the activations of a field that computes its hidden layer.
  bool takes_rounded() const {
    return shape_.precision == Precision::bf16 && kernels_->rounded_hidden_forward != nullptr;
  }

  void declare(ParamDeclarer& declarer) const override;
  void derive(const StepContext& ctx, const Tensors<Real>& tensors) const override;

  /// The hidden layer for a field that computes it; with gradients where the tensors have them.
  HiddenLayer<Real> hidden_layer(const Tensors<Real>& tensors) const;
  /// hidden [M, H] = relu(feature [M, F] W1 + b1).
  void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const;
  /// d_hidden [M, H] is overwritten (masked by the ReLU); d_feature [M, F] = dL/dfeature.
  void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const;
  /// The same in bf16 from end to end; d_hidden is already the gradient before the ReLU. Only where takes_rounded().
  void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                      View<Bf16> hidden) const;
  void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                       View<const Bf16> d_hidden, View<Bf16> d_feature) const;

  /// logits [N, C] = h [N, H] W2 + share [N, 1] b2. Once a ray: h composited, share the opacity. Once a sample (the
  /// deferral switched off): h the hidden activations, share empty (taken as 1).
  void class_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                     View<Real> logits) const;
  /// d_h [N, H] = d_logits W2^T; d_share [N, 1] = d_logits . b2 (when not empty).
  void class_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                      View<const Real> d_logits, View<Real> d_h, View<Real> d_share) const;

 private:
  HeadShape shape_;
  const HeadKernels<Real>* kernels_;
};

extern template class SemanticHead<float>;
extern template class SemanticHead<double>;

}  // namespace semfield
