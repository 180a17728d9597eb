// Semantic heads: position-only feature to activations a sample, and after compositing to class logits a ray.
#pragma once

#include <vector>

#include "model/head_kernels.h"
#include "plugin/field.h"

namespace semfield {

/// What a pass asks of a head: a position-only feature becomes activations h a sample, and h becomes class logits by a
/// layer that is linear, so that compositing may stand between them: S(r) = class(sum_k w_k h_k) [Zhi21, Eq. 6 with
/// linearity]. A head sees no view direction.
template <class Real>
class SemanticHead : public Parametric<Real> {
 public:
  virtual std::int32_t hidden_width() const = 0;  ///< H, numbers of an activation
  virtual std::int32_t classes() const = 0;
  /// Whether it takes a feature in bf16, or the activations of a field that computes its one hidden layer.
  virtual bool takes_rounded() const { return false; }

  /// hidden [M, H] from feature [M, F].
  virtual void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                              View<Real> hidden) const = 0;
  /// d_hidden [M, H] may be overwritten; d_feature [M, F] = dL/dfeature.
  virtual void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                               View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const = 0;

  /// Only where takes_rounded(): the hidden layer relu(feature W + b) for a field that computes it, with gradients
  /// where the tensors have them; and the calls above in bf16 from end to end, d_hidden already before the ReLU.
  virtual HiddenLayer<Real> hidden_layer(const Tensors<Real>& tensors) const;
  virtual void rounded_hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                                      View<Bf16> hidden) const;
  virtual void rounded_hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                                       View<const Bf16> d_hidden, View<Bf16> d_feature) const;

  /// logits [N, C] from h [N, H], linear in (h, share). Once a ray: h composited, share [N, 1] the opacity. Once a
  /// sample (the deferral switched off): h the hidden activations, share empty (taken as 1).
  virtual void class_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                             View<const Real> share, View<Real> logits) const = 0;
  /// d_h [N, H] and, when not empty, d_share [N, 1].
  virtual void class_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                              View<const Real> share, View<const Real> d_logits, View<Real> d_h,
                              View<Real> d_share) const = 0;
};

/// The head of Semantic-NeRF: h = relu(feature W1 + b1), logits = h W2 + share b2.
template <class Real>
class OneLayerHead final : public SemanticHead<Real> {
 public:
  /// `kernels` must live as long as the head.
  explicit OneLayerHead(const HeadShape& shape, const HeadKernels<Real>& kernels = processor_head_kernels<Real>());

  std::int32_t hidden_width() const override { return shape_.hidden; }
  std::int32_t classes() const override { return shape_.classes; }
  bool takes_rounded() const override {
    return shape_.precision == Precision::bf16 && kernels_->rounded_hidden_forward != nullptr;
  }

  void declare(ParamDeclarer& declarer) const override;
  void derive(const StepContext& ctx, const Tensors<Real>& tensors) const override;
  HiddenLayer<Real> hidden_layer(const Tensors<Real>& tensors) const override;
  void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const override;
  void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const override;
  void rounded_hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                              View<Bf16> hidden) const override;
  void rounded_hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                               View<const Bf16> d_hidden, View<Bf16> d_feature) const override;
  void class_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                     View<Real> logits) const override;
  void class_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h, View<const Real> share,
                      View<const Real> d_logits, View<Real> d_h, View<Real> d_share) const override;

 private:
  HeadShape shape_;
  std::vector<TensorSpec> specs_;
  const HeadKernels<Real>* kernels_;
};

extern template class SemanticHead<float>;
extern template class SemanticHead<double>;
extern template class OneLayerHead<float>;
extern template class OneLayerHead<double>;

}  // namespace semfield
