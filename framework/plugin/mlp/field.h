// A field that is a network of layers: its constructor says which, and everything else is done.
#pragma once

#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/check.h"
#include "core/view.h"
#include "plugin/field.h"
#include "plugin/mlp/mlp.h"

namespace semfield {

/// A field derives from it, puts `net()` together in its constructor and ends that with give(). A field with faster
/// kernels of its own overrides what they do.
template <class Real>
class MlpField : public Field<Real> {
 public:
  FieldTraits traits() const noexcept override { return {feature_.cols, net_.graph().ray_dims > 0}; }
  FeatureForm feature_form(std::int32_t hidden_width) const noexcept override {
    const bool whole_vectors = feature_.cols % 32 == 0 && hidden_width % 32 == 0;  // rows without padding
    return net_.rounds() && whole_vectors ? FeatureForm::rounded : FeatureForm::full;
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t) const noexcept override {
    return net_.saved_bytes(samples);
  }
  void declare(ParamDeclarer& declarer) const override { net_.declare(declarer); }
  void derive(const StepContext& ctx, const Tensors<Real>& tensors) const override { net_.derive(ctx, tensors); }
  void derive_backward(const StepContext& ctx, const Tensors<Real>& tensors) const override {
    net_.derive_backward(ctx, tensors);
  }

 protected:
  /// owner: "field 'waves'", as in messages. Throws Error(config) without an encoded position, Error(unavailable)
  /// where there are no kernels for the device and precision.
  MlpField(const FieldBuild& build, const KernelTables& kernels, std::string_view owner);

  Mlp<Real>& net() { return net_; }
  const Mlp<Real>& net() const { return net_; }
  Rows position() const { return net_.samples(); }
  Rows direction() const { return net_.rays(); }  ///< no columns where the build has no direction
  Rows layer(const LayerSpec& spec) { return net_.layer(spec); }
  /// The network's outputs: density before its activation [M, 1], colour in (0, 1) [M, 3], and what the semantic head
  /// reads, a function of the position alone.
  void give(Rows sigma, Rows rgb, Rows feature) {
    feature_ = feature;
    net_.output(feature_only_ ? Rows() : sigma);
    net_.output(feature_only_ ? Rows() : rgb);
    net_.output(feature);
    net_.seal();
  }

  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override;
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) const override;

 private:
  Mlp<Real> net_;
  Rows feature_;
  bool feature_only_;
};

extern template class MlpField<float>;
extern template class MlpField<double>;

// A field that is a network of layers and has kernels that compute all of it at once, for the shapes that they take.

/// d sigmoid(x) / dx from y = sigmoid(x).
template <class Real>
SEMFIELD_HD inline Real sigmoid_slope(Real y) {
  return y * (Real(1) - y);
}

/// A layer's tensors by index; -1: the network has no such layer.
struct LayerTensors {
  int weight = -1, bias = -1;
};

/// Kernels of a whole field for one device and precision, private to the field's folder. Shape: what they know of its
/// network, with a function layer_by_layer(const Shape&) that says why they do not take it.
template <class Real, class Shape>
struct FusedKernels {
  /// Whether they compute this network on the current device. The answer for a shape never changes.
  bool (*serve)(const Shape& shape) = nullptr;
  void (*forward)(const Shape& shape, const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) = nullptr;
  void (*backward)(const Shape& shape, const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) = nullptr;
  std::size_t (*saved_bytes)(const Shape& shape, std::int64_t samples) = nullptr;
  FeatureForm (*feature_form)(const Shape& shape, std::int32_t hidden_width) = nullptr;
};

/// A field derives from it as from MlpField, and ends its constructor with fuse(). Where there are no such kernels, or
/// they do not serve, the network is computed layer by layer.
template <class Real, class Shape>
class FusedMlpField : public MlpField<Real> {
  using Layered = MlpField<Real>;

 public:
  FeatureForm feature_form(std::int32_t hidden_width) const noexcept override {
    return fused() ? kernels_->feature_form(shape_, hidden_width) : Layered::feature_form(hidden_width);
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return fused() ? kernels_->saved_bytes(shape_, samples) : Layered::saved_bytes(samples, rays);
  }
  std::string slow_path() const override {
    return kernels_ == nullptr || fused() ? std::string() : layer_by_layer(shape_);
  }

 protected:
  using Layered::Layered;

  LayerTensors tensors_of(std::string_view name) const {
    const MlpLayer* const layer = this->net().find(name);
    return layer == nullptr ? LayerTensors{} : LayerTensors{layer->weight, layer->bias};
  }

  void fuse(const FieldBuild& build, const KernelTables& kernels, Shape shape) {
    shape_ = std::move(shape);
    kernels_ = kernels.find<FusedKernels<Real, Shape>>(build.device, build.precision);
  }

  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override {
    if (!fused()) return Layered::do_forward(ctx, tensors, in, out, saved);
    SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
    kernels_->forward(shape_, ctx, tensors, in, out, saved);
  }
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) const override {
    if (!fused()) return Layered::do_backward(ctx, tensors, in, out, grad, saved, d_position);
    SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
    SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
    kernels_->backward(shape_, ctx, tensors, in, out, grad, saved, d_position);
  }

 private:
  bool fused() const noexcept { return kernels_ != nullptr && kernels_->serve(shape_); }

  const FusedKernels<Real, Shape>* kernels_ = nullptr;
  Shape shape_;
};

}  // namespace semfield
