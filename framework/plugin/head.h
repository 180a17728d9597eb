// Head: a feature per sample to activations, and per ray, after compositing, to a row of the channel that it makes.
#pragma once

#include <string>
#include <vector>

#include "core/check.h"
#include "core/half.h"
#include "plugin/field.h"
#include "plugin/layer_weights.h"
#include "plugin/parametric.h"

namespace semfield {

/// A feature of the position becomes activations h per sample, and h becomes a row of the channel by a layer that is
/// linear, so that compositing may stand between them: y(r) = output(sum_k w_k h_k) [Zhi21, Eq. 6 with linearity]. A
/// head sees no view direction.
template <class Real>
class Head : public Parametric<Real> {
 public:
  virtual std::int32_t hidden_width() const = 0;  ///< H, numbers of an activation
  virtual std::int32_t width() const = 0;         ///< C, columns of the channel: of class logits, the classes

  /// hidden [M, H] from feature [M, F].
  virtual void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                              View<Real> hidden) const = 0;
  /// d_hidden [M, H] may be overwritten; d_feature [M, F] = dL/dfeature.
  virtual void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                               View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const = 0;

  /// rows [N, C] from h [N, H], linear in (h, opacity). Once per ray: h composited, opacity [N, 1] the sum of its
  /// weights. Once per sample (the deferral switched off): h the activations, opacity empty (taken as 1).
  virtual void output_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                              View<const Real> opacity, View<Real> rows) const = 0;
  /// d_h [N, H] and, when not empty, d_opacity [N, 1].
  virtual void output_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                               View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                               View<Real> d_opacity) const = 0;

  /// Whether it takes a feature in bf16, or the activations of a field that computes its one hidden layer.
  virtual bool takes_rounded() const { return false; }
  /// Only where takes_rounded(): the hidden layer relu(feature W + b) for a field that computes it, with gradients
  /// where the tensors have them; and the calls above in bf16 from end to end, d_hidden already before the ReLU.
  virtual HiddenLayer<Real> hidden_layer(const Tensors<Real>&) const {
    SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was asked for its hidden layer");
    return {};
  }
  virtual void rounded_hidden_forward(const StepContext&, const Tensors<Real>&, View<const Bf16>, View<Bf16>) const {
    SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given some");
  }
  virtual void rounded_hidden_backward(const StepContext&, const Tensors<Real>&, View<const Bf16>, View<const Bf16>,
                                       View<Bf16>) const {
    SEMFIELD_CHECK(takes_rounded(), "a head without bf16 activations was given gradients of some");
  }
};

/// What a head that is built knows. The head that makes class logits is the framework's own.
struct HeadBuild {
  Device device = Device::cpu;
  std::int32_t feature_dims = 0;  ///< F
  std::int32_t width = 0;         ///< C
};

// What a device computes for a head of one hidden layer.

struct HeadShape {
  std::int32_t feature = 0, hidden = 0, width = 0;
  Precision precision = Precision::fp32;         ///< of the hidden layer, a product per sample; the output stays fp32
  std::string output = "class";                  ///< name of the output layer's tensors
  LayerWeight hidden_weight{}, output_weight{};  ///< on a CPU
};

/// The head's learned tensors, in this order.
enum HeadTensor : std::size_t { kHiddenWeight, kHiddenBias, kOutputWeight, kOutputBias };

/// Shapes and meaning are those of Head's calls. A null entry is work that the device has no use for.
template <class Real>
struct HeadKernels {
  /// Of the rearranged tensors, which a device that needs none does not have.
  void (*derive)(const HeadShape& shape, const Tensors<Real>& tensors) = nullptr;
  void (*hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                         View<const Real> feature, View<Real> hidden) = nullptr;
  void (*hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                          View<const Real> feature, View<const Real> hidden, View<Real> d_hidden,
                          View<Real> d_feature) = nullptr;
  void (*output_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                         View<const Real> opacity, View<Real> rows) = nullptr;
  void (*output_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors, View<const Real> h,
                          View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                          View<Real> d_opacity) = nullptr;
  /// The hidden layer with feature and activations in bf16; d_hidden is already the gradient before the ReLU. Null
  /// where the device's activations are never bf16.
  void (*rounded_hidden_forward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                 View<const Bf16> feature, View<Bf16> hidden) = nullptr;
  void (*rounded_hidden_backward)(const HeadShape& shape, Workspace& arena, const Tensors<Real>& tensors,
                                  View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) = nullptr;
};

/// Those of the CPU.
template <class Real>
const HeadKernels<Real>& cpu_head_kernels();

// The head of one hidden layer: that of class rows, and of any other channel.

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

  void declare(ParamDeclarer& declarer) const override {
    for (const TensorSpec& spec : specs_) declarer.tensor(spec);
  }
  void derive(const StepContext&, const Tensors<Real>& tensors) const override {
    if (kernels_->derive != nullptr) kernels_->derive(shape_, tensors);
  }
  HiddenLayer<Real> hidden_layer(const Tensors<Real>& tensors) const override {
    HiddenLayer<Real> layer{tensors.value[kHiddenWeight], tensors.value[kHiddenBias], {}, {}};
    if (tensors.grad.empty()) return layer;
    layer.d_weight = tensors.grad[kHiddenWeight];
    layer.d_bias = tensors.grad[kHiddenBias];
    return layer;
  }
  void hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const override {
    if (feature.rows > 0) kernels_->hidden_forward(shape_, *ctx.workspace, tensors, feature, hidden);
  }
  void hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const override {
    if (feature.rows > 0)
      kernels_->hidden_backward(shape_, *ctx.workspace, tensors, feature, hidden, d_hidden, d_feature);
  }
  void rounded_hidden_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                              View<Bf16> hidden) const override {
    if (feature.rows > 0) kernels_->rounded_hidden_forward(shape_, *ctx.workspace, tensors, feature, hidden);
  }
  void rounded_hidden_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Bf16> feature,
                               View<const Bf16> d_hidden, View<Bf16> d_feature) const override {
    if (feature.rows > 0)
      kernels_->rounded_hidden_backward(shape_, *ctx.workspace, tensors, feature, d_hidden, d_feature);
  }
  void output_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                      View<const Real> opacity, View<Real> rows) const override {
    if (h.rows > 0) kernels_->output_forward(shape_, *ctx.workspace, tensors, h, opacity, rows);
  }
  void output_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const Real> h,
                       View<const Real> opacity, View<const Real> d_rows, View<Real> d_h,
                       View<Real> d_opacity) const override {
    if (h.rows > 0) kernels_->output_backward(shape_, *ctx.workspace, tensors, h, opacity, d_rows, d_h, d_opacity);
  }

 private:
  HeadShape shape_;
  std::vector<TensorSpec> specs_;
  const HeadKernels<Real>* kernels_;
};

extern template class OneLayerHead<float>;
extern template class OneLayerHead<double>;

}  // namespace semfield
