// The network of NeRF and Semantic-NeRF: a deep trunk on the encoded position, a density, and a colour that sees the
// direction.
#pragma once

#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/slow_path.h"
#include "fields/nerf_mlp/nerf_mlp_kernels.h"
#include "plugin/field.h"
#include "plugin/kernels.h"

namespace semfield {

struct NerfMlpParams {
  int depth = 8;
  int width = 256;
  int skip_at = 5;
  int view_width = 128;
};

void describe(ParamVisitor& visit, NerfMlpParams& params);
void validate(const NerfMlpParams& params, Diagnostics& diagnostics);

/// [Mildenhall20 Fig. 7], [Zhi21 Fig. 2]. Weights are [in, out]; M samples, x encoded position, d encoded direction:
///   h_0 = relu(x W_0 + b_0), h_i = relu([x at i = skip_at,] h_{i-1} W_i + b_i); h = h_{depth-1} is the feature of the
///   semantic head; sigma = h W_density + b; f = h W_feature + b; v = relu([f, d] W_view + b); rgb = sigmoid(v W_color
///   + b).
/// Without a direction (direction_dims = 0) the feature layer is left out: v = relu(h W_view + b).
///
/// Exact savings: with fold_feature_layer, W_feature W_view[0:width] and its bias are derived tensors computed once a
/// step and their gradients are handed on to both factors; with direction_once_per_ray, d W_view[width:] + bias is a
/// row per ray.
template <class Real>
class NerfMlp final : public Field<Real>, public SlowPath {
 public:
  NerfMlp(const NerfMlpParams& params, const FieldBuild& build, const KernelTables& kernels);
  FieldTraits traits() const noexcept override { return {shape_.width, shape_.has_direction()}; }
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
  void derive_backward(const StepContext& ctx, const Tensors<Real>& tensors) const override;

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override;
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                   const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) const override;

 private:
  const NerfMlpKernels<Real>* kernels_;
  NerfMlpShape shape_;
  std::vector<TensorSpec> specs_;
};

extern template class NerfMlp<float>;
extern template class NerfMlp<double>;

}  // namespace semfield
