// A network of layers that fields, branches and heads are put together from: they say which layers there are, and the
// network declares the tensors, runs forward and backward on every device and precision, and says what that costs.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "plugin/kernels.h"
#include "plugin/layer_shape.h"
#include "plugin/mlp/graph.h"

namespace semfield {

/// What a component that is built knows of its network.
struct MlpBuild {
  Device device = Device::cpu;
  Precision precision = Precision::fp32;  ///< of the products of samples
  std::int32_t sample_dims = 0;
  std::int32_t ray_dims = 0;  ///< 0: no ray input
  bool fold = true;           ///< two linear layers with nothing between them become one, once per step
  bool rays_once = true;      ///< what a ray input adds is computed once per ray, not once per sample
};

/// y = activation(x W + b), x the inputs side by side. Inputs without columns are left out.
struct LayerSpec {
  std::string name;  ///< tensors "name/weight" [in, width] and "name/bias" [1, width]
  std::vector<Rows> inputs;
  std::int32_t width = 0;
  LayerActivation activation = LayerActivation::relu;
  double frequency = 30;  ///< of sine
};

/// How tensors start: uniform within 1 / sqrt(in). A sine layer's weight as in [Sitzmann20 Sec. 3.2]: within 1 / in
/// where it reads the sample input, else within sqrt(6 / in) / frequency.
///
/// First the layers are named, in the order in which they are computed, then the outputs, then seal() once. Layers that
/// no output needs are dropped. Formulas are those of compute/layers.h on a CPU and cuda/mlp.cpp on a GPU; a call saves
/// activations, of a sine also its slope, in `saved`.
template <class Real>
class Mlp final : public Parametric<Real> {
 public:
  /// Throws Error(unavailable) where `owner` ("field 'waves'") has no kernels for the device and precision.
  Mlp(const MlpBuild& build, const KernelTables& kernels, std::string_view owner);

  Rows samples() const { return {kSampleInput, 0, graph_.sample_dims}; }
  Rows rays() const { return {kRayInput, 0, graph_.ray_dims}; }
  Rows layer(const LayerSpec& spec);
  /// `count` layers of one width, named name_0, name_1, ...; the one numbered `skip_at` (0: none) reads `from` again,
  /// in front of the layer before.
  Rows chain(const LayerSpec& spec, int count, int skip_at = 0);
  /// Numbered 0, 1, ... in order; an output without columns is never wanted. An output is a whole layer, or columns of
  /// one without activation. A layer may be read and be an output.
  void output(Rows rows);
  void seal();

  const MlpGraph& graph() const { return graph_; }
  /// Whether an output can be given in bf16.
  bool rounds() const { return kernels_->rounds; }
  /// A layer, for kernels that read its tensors themselves. Null: there is none of this name.
  const MlpLayer* find(std::string_view name) const;
  /// Indices of a linear layer that was multiplied with the next.
  const MlpFold* fold() const { return graph_.folds.empty() ? nullptr : graph_.folds.data(); }

  void declare(ParamDeclarer& declarer) const override;
  void derive(const StepContext&, const Tensors<Real>& tensors) const override { kernels_->derive(graph_, tensors); }
  void derive_backward(const StepContext&, const Tensors<Real>& tensors) const override {
    kernels_->derive_backward(graph_, tensors);
  }
  std::size_t saved_bytes(std::int64_t samples) const { return kernels_->saved_bytes(graph_, samples); }
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t rays) const {
    return kernels_->scratch_bytes == nullptr ? 0 : kernels_->scratch_bytes(graph_, samples, rays);
  }
  /// Products of derive and of a forward that gives every output.
  std::vector<LayerShape> layers() const;

  /// saved may be empty when no backward will follow.
  void forward(Workspace& arena, const Tensors<Real>& tensors, const MlpIn<Real>& in, MlpOuts<Real> out,
               Saved saved) const {
    kernels_->forward(graph_, arena, tensors, in, out, saved);
  }
  /// tensors.grad += dL/dtheta; d_samples [M, sample_dims] = dL/d(samples) when not empty. `out` is what forward gave.
  void backward(Workspace& arena, const Tensors<Real>& tensors, const MlpIn<Real>& in, MlpOuts<Real> out,
                MlpGrads<Real> grad, Saved saved, View<Real> d_samples) const {
    kernels_->backward(graph_, arena, tensors, in, out, grad, saved, d_samples);
  }

 private:
  void drop_unneeded();
  void declare_layers(std::vector<MlpLayer>& layers);
  void multiply_linear_pairs();
  void rearrange_weights();

  const MlpKernels<Real>* kernels_;
  MlpBuild build_;
  MlpGraph graph_;
  std::vector<TensorSpec> specs_;
};

/// Adds the kernels of a CPU.
void mlp_kernels(KernelTables& tables);

extern template class Mlp<float>;
extern template class Mlp<double>;

}  // namespace semfield
