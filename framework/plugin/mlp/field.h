// A field that is a network of layers: its constructor says which, and everything else is done.
#pragma once

#include <string_view>
#include <vector>

#include "plugin/field.h"
#include "plugin/mlp/mlp.h"

namespace semfield {

/// A field derives from it, puts `net()` together in its constructor and ends that with give(). A field with faster
/// kernels of its own overrides what they do.
template <class Real>
class MlpField : public Field<Real> {
 public:
  FieldTraits traits() const noexcept override { return {feature_.cols, net_.graph().ray_dims > 0}; }
  FeatureForm feature_form(std::int32_t hidden_width) const noexcept override;
  std::size_t saved_bytes(std::int64_t samples, std::int64_t) const noexcept override {
    return net_.saved_bytes(samples);
  }
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return net_.scratch_bytes(samples, rays);
  }
  std::vector<LayerShape> layers() const override { return net_.layers(); }
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
  void give(Rows sigma, Rows rgb, Rows feature);

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

}  // namespace semfield
