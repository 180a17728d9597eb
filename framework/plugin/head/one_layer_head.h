// The head of one hidden layer: that of class rows, and of any other channel.
#pragma once

#include <vector>

#include "plugin/head/head.h"
#include "plugin/head/head_kernels.h"

namespace semfield {

/// The head of Semantic-NeRF: h = relu(feature W1 + b1), rows = h W2 + opacity b2.
template <class Real>
class OneLayerHead : public Head<Real> {
 public:
  /// `kernels` must live as long as the head.
  explicit OneLayerHead(const HeadShape& shape, const HeadKernels<Real>& kernels = cpu_head_kernels<Real>());

  std::int32_t hidden_width() const override { return shape_.hidden; }
  std::int32_t width() const override { return shape_.width; }
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
  void output_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                      View<const Real> opacity, View<Real> rows) const override;
  void output_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                       View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                       View<Real> d_opacity) const override;

 private:
  HeadShape shape_;
  std::vector<TensorSpec> specs_;
  const HeadKernels<Real>* kernels_;
};

extern template class OneLayerHead<float>;
extern template class OneLayerHead<double>;

}  // namespace semfield
