// The small network behind a learned encoding: one hidden layer to density and geometry features, two to colour.
#pragma once

#include <array>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/slow_path.h"
#include "fields/tiny_mlp/tiny_mlp_kernels.h"
#include "plugin/field.h"
#include "plugin/kernels.h"

namespace semfield {

struct TinyMlpParams {
  int hidden_width = 64;
  int hidden_layers = 1;
  int geometry_features = 15;
  int color_width = 64;
  int color_layers = 2;
  TinyFeature feature = TinyFeature::hidden;
};

template <>
struct ChoiceNames<TinyFeature> {
  static constexpr std::array<std::string_view, 2> names{"hidden", "geometry"};
};

void describe(ParamVisitor& visit, TinyMlpParams& params);
void validate(const TinyMlpParams& params, Diagnostics& diagnostics);

/// [Mueller22 Sec. 5.4], with biases. Weights are [in, out]; x encoded position, d encoded direction:
///   h = relu(... relu(x W_hidden_0 + b) ...); [sigma, g] = h W_geometry + b;
///   c = relu(... relu([g, d] W_color_0 + b) ...); rgb = sigmoid(c W_rgb + b).
/// The semantic head reads h (feature: hidden) or g (feature: geometry). Without a direction c sees g alone.
/// Exact saving direction_once_per_ray: d W_color_0[G:] + b is a row per ray.
template <class Real>
class TinyMlp final : public Field<Real>, public SlowPath {
 public:
  TinyMlp(const TinyMlpParams& params, const FieldBuild& build, const KernelTables& kernels);
  FieldTraits traits() const noexcept override { return {shape_.feature_dims(), shape_.has_direction()}; }
  FeatureForm feature_form(std::int32_t hidden_width) const noexcept override {
    return kernels_->feature_form == nullptr ? FeatureForm::full : kernels_->feature_form(shape_, hidden_width);
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override;
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept override;
  std::vector<LayerShape> layers() const override;
  std::string slow_path() const override {
    return kernels_->slow != nullptr && kernels_->slow(shape_) ? layer_by_layer(shape_) : std::string();
  }
  void declare(ParamDeclarer& declarer) const override;
  void derive(const StepContext& ctx, const Tensors<Real>& tensors) const override;

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override;
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) const override;

 private:
  const TinyMlpKernels<Real>* kernels_;
  TinyMlpShape shape_;
  std::vector<TensorSpec> specs_;
};

extern template class TinyMlp<float>;
extern template class TinyMlp<double>;

}  // namespace semfield
