// A network field that has, for some devices and shapes, kernels of its own which compute it at once.
#pragma once

#include <string>
#include <string_view>
#include <type_traits>

#include "core/slow_path.h"
#include "plugin/mlp/field.h"

namespace semfield {

/// Same function and tensors as the layers, in the shapes that `serves` names; `serves` of a shape never changes
/// between a forward and its backward. The table's key is Shape, which is the plugin's own.
template <class Shape>
struct FusedFieldKernels {
  bool (*serves)(const Shape& shape) = nullptr;
  void (*forward)(const Shape& shape, const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                  const FieldOut<float>& out, Saved saved) = nullptr;
  void (*backward)(const Shape& shape, const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
                   const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                   View<float> d_position) = nullptr;
  std::size_t (*saved_bytes)(const Shape& shape, std::int64_t samples) = nullptr;
  FeatureForm (*feature_form)(const Shape& shape, std::int32_t hidden_width) = nullptr;
};

/// `std::string layer_by_layer(const Shape&)` says why a device with such kernels computes a shape without them.
template <class Real, class Shape>
class FusedMlpField : public MlpField<Real>, public SlowPath {
  using Layers = MlpField<Real>;

 public:
  FeatureForm feature_form(std::int32_t hidden_width) const noexcept override {
    return fused() ? fused_->feature_form(shape_, hidden_width) : Layers::feature_form(hidden_width);
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return fused() ? fused_->saved_bytes(shape_, samples) : Layers::saved_bytes(samples, rays);
  }
  std::string slow_path() const override {
    return fused_ != nullptr && !fused() ? layer_by_layer(shape_) : std::string();
  }

 protected:
  FusedMlpField(const FieldBuild& build, const KernelTables& kernels, std::string_view owner)
      : Layers(build, kernels, owner) {
    if constexpr (std::is_same_v<Real, float>)
      fused_ = kernels.find<FusedFieldKernels<Shape>>(build.device, build.precision);
  }

  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override {
    if constexpr (std::is_same_v<Real, float>) {
      if (fused()) return fused_->forward(shape_, ctx, tensors, in, out, saved);
    }
    Layers::do_forward(ctx, tensors, in, out, saved);
  }
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) const override {
    if constexpr (std::is_same_v<Real, float>) {
      if (fused()) return fused_->backward(shape_, ctx, tensors, in, out, grad, saved, d_position);
    }
    Layers::do_backward(ctx, tensors, in, out, grad, saved, d_position);
  }

  Shape shape_;  ///< filled by the constructor of the field

 private:
  bool fused() const { return fused_ != nullptr && fused_->serves(shape_); }

  const FusedFieldKernels<Shape>* fused_ = nullptr;
};

}  // namespace semfield
