// The fixed semantic head: position-only feature -> hidden (ReLU) -> class logits, with the class layer deferred to
// once a ray.
#pragma once

#include "core/gemm.h"
#include "plugin/parametric.h"

namespace semfield {

/// S(r) = W2 (sum_k w_k h_k) + b2 sum_k w_k: the class layer and compositing are both linear, so the hidden activations
/// are composited and the class layer is applied once a ray [Zhi21, Eq. 6 with linearity]. The head sees no view
/// direction: its only input is the field's position-only feature.
template <class Real>
class SemanticHead final : public Parametric<Real> {
 public:
  /// precision: of the hidden layer, a product a sample; the class layer, once a ray, stays fp32.
  SemanticHead(std::int32_t feature_dims, std::int32_t hidden_width, std::int32_t classes,
               Precision precision = Precision::fp32);

  std::int32_t hidden_width() const { return hidden_; }
  std::int32_t classes() const { return classes_; }

  void declare(ParamDeclarer& declarer) const override;
  void derive(const StepContext& ctx, const Tensors<Real>& tensors) const override;

  /// hidden [M, H] = relu(feature [M, F] W1 + b1).
  void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const;
  /// d_hidden [M, H] is overwritten (masked by the ReLU); d_feature [M, F] = dL/dfeature.
  void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const;

  /// logits [N, C] = h [N, H] W2 + share [N, 1] b2. Once a ray: h composited, share the opacity. Once a sample (the
  /// deferral switched off): h the hidden activations, share empty (taken as 1).
  void class_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                     View<Real> logits) const;
  /// d_h [N, H] = d_logits W2^T; d_share [N, 1] = d_logits . b2 (when not empty).
  void class_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                      View<const Real> d_logits, View<Real> d_h, View<Real> d_share) const;

 private:
  std::int32_t feature_, hidden_, classes_;
  Precision precision_;
};

extern template class SemanticHead<float>;
extern template class SemanticHead<double>;

}  // namespace semfield
