// A network of layers that fields, branches and heads are put together from: they say which layers there are, and the
// network declares the tensors, runs forward and backward on every device and precision, and says what that costs.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/half.h"
#include "core/workspace.h"
#include "plugin/field.h"
#include "plugin/kernels.h"
#include "plugin/layer_weights.h"
#include "plugin/parametric.h"

namespace semfield {

/// What follows a layer's sums z. sine: sin(frequency z) [Sitzmann20]. sigmoid: of an output, in (0, 1).
enum class LayerActivation : std::uint8_t { none, relu, sine, sigmoid };

/// Numbers per sample within a network: columns [first, first + cols) of an input or of a layer. cols = 0: none.
struct Rows {
  int node = -1;
  std::int32_t first = 0, cols = 0;

  bool empty() const { return cols == 0; }
  Rows columns(std::int32_t from, std::int32_t count) const { return {node, first + from, count}; }
  bool operator==(const Rows&) const = default;
};

/// Nodes of a network: its two inputs, then its layers in order.
inline constexpr int kSampleInput = 0, kRayInput = 1, kFirstLayer = 2;

/// One of the inputs that a layer reads side by side, and its rows of the layer's weight. The weight of a ray input is
/// read as it is: nothing of it is rearranged.
struct MlpPart {
  Rows from;
  LayerWeight weight;
  int number = 0;  ///< of the network's parts
};

struct MlpLayer {
  std::string name;
  std::int32_t width = 0;
  LayerActivation activation = LayerActivation::none;
  double frequency = 1;  ///< of sine
  int weight = -1, bias = -1;
  std::vector<MlpPart> parts;
  bool exact = false;  ///< an output without a hidden activation: its sums are not rounded
  Rows read;           ///< of an exact layer: the columns that other layers read
  int fold = -1;       ///< its first part reads the product folds[fold]
};

/// Two linear layers with nothing between them, multiplied once per step: P = F V, p = b_F V + b_V, with F [in, mid]
/// and V the rows [first, first + mid) of the second layer's weight.
struct MlpFold {
  std::int32_t in = 0, mid = 0, out = 0, first = 0;
  int first_weight = -1, first_bias = -1, second_weight = -1, second_bias = -1;
  int weight = -1, bias = -1;  ///< P [in, out] and p [1, out]
  LayerWeight second;          ///< V, whose transpose derive_backward reads
};

inline constexpr int kMostMlpLayers = 48, kMostMlpParts = 48, kMostMlpOutputs = 4;

struct MlpGraph {
  Precision precision = Precision::fp32;
  bool rays_once = true;  ///< what a ray input adds is computed once per ray
  std::int32_t sample_dims = 0, ray_dims = 0;
  std::vector<MlpLayer> layers;
  std::vector<MlpFold> folds;
  std::vector<Rows> outputs;

  const MlpLayer& layer(int node) const { return layers[static_cast<std::size_t>(node - kFirstLayer)]; }
};

/// M samples of R rays.
template <class Real>
struct MlpIn {
  View<const Real> samples;                ///< [M, sample_dims]
  View<const Real> rays;                   ///< [R, ray_dims]; empty without a ray input
  View<const std::int32_t> ray_of_sample;  ///< [M, 1], ascending; empty without a ray input
};
/// An output [M, cols], or the same rounded. Both empty: not wanted.
template <class Real>
struct MlpOut {
  View<Real> rows;
  View<Bf16> rounded;
  bool empty() const { return rows.empty() && rounded.empty(); }
};
/// dL/d(output). Both empty: zero; so are the rows behind `rounded`.
template <class Real>
struct MlpGrad {
  View<const Real> rows;
  View<const Bf16> rounded;
  bool empty() const { return rows.empty() && rounded.empty(); }
};

/// A call's outputs and, of a backward, their gradients: one each for MlpGraph::outputs.
template <class Real>
using MlpOuts = std::span<const MlpOut<Real>>;
template <class Real>
using MlpGrads = std::span<const MlpGrad<Real>>;

/// Of a device and a precision. Tensors are those that the network declared.
template <class Real>
struct MlpKernels {
  void (*forward)(const MlpGraph&, Workspace&, const Tensors<Real>&, const MlpIn<Real>&, MlpOuts<Real>,
                  Saved) = nullptr;
  void (*backward)(const MlpGraph&, Workspace&, const Tensors<Real>&, const MlpIn<Real>&, MlpOuts<Real>, MlpGrads<Real>,
                   Saved, View<Real> d_samples) = nullptr;
  void (*derive)(const MlpGraph&, const Tensors<Real>&) = nullptr;
  void (*derive_backward)(const MlpGraph&, const Tensors<Real>&) = nullptr;
  std::size_t (*saved_bytes)(const MlpGraph&, std::int64_t samples) = nullptr;
  bool rounds = false;  ///< rows between layers are bf16, so an output can leave as MlpOut::rounded
};

// What a walk through a network asks of a backend: rows of a device and precision, and the products of layers. Private
// to the files that make the kernel tables.

/// y = start + x W of one input, for the layer's columns [first, first + cols): `exact`, or `y` after the ReLU or as it
/// is. start: the bias [1, cols], a row per sample (which may be `exact`), or row row_of[m].
template <class B>
struct MlpProduct {
  View<const typename B::Act> x;
  View<const typename B::Real> start;
  bool starts_from_bias = false;
  View<const std::int32_t> row_of;
  Rows columns;
  bool relu = false;
  View<typename B::Act> y;
  View<typename B::Real> exact;
};
/// start + dz W^T: `exact`, or `y` where `mask` is empty or positive, else 0.
template <class B>
struct MlpInputGradient {
  View<const typename B::Act> dz;
  View<const typename B::Real> start;
  View<const typename B::Act> mask;
  View<typename B::Act> y;
  View<typename B::Real> exact;
};

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
  void output(Rows rows) { graph_.outputs.push_back(rows); }
  void seal();

  const MlpGraph& graph() const { return graph_; }
  /// Whether an output can be given in bf16.
  bool rounds() const { return kernels_->rounds; }
  /// A layer, for kernels that read its tensors themselves. Null: there is none of this name.
  const MlpLayer* find(std::string_view name) const {
    const auto at = std::find_if(graph_.layers.begin(), graph_.layers.end(),
                                 [&](const MlpLayer& layer) { return layer.name == name; });
    return at == graph_.layers.end() ? nullptr : &*at;
  }
  /// Indices of a linear layer that was multiplied with the next.
  const MlpFold* fold() const { return graph_.folds.empty() ? nullptr : graph_.folds.data(); }

  void declare(ParamDeclarer& declarer) const override {
    for (const TensorSpec& spec : specs_) declarer.tensor(spec);
  }
  void derive(const StepContext&, const Tensors<Real>& tensors) const override { kernels_->derive(graph_, tensors); }
  void derive_backward(const StepContext&, const Tensors<Real>& tensors) const override {
    kernels_->derive_backward(graph_, tensors);
  }
  std::size_t saved_bytes(std::int64_t samples) const { return kernels_->saved_bytes(graph_, samples); }

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
