// A network of layers as plain data, and what its kernels are given: behind plugin/mlp/mlp.h.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "compute/precision.h"
#include "core/bf16.h"
#include "core/workspace.h"
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
  /// Null: not planned ahead on this device.
  std::size_t (*scratch_bytes)(const MlpGraph&, std::int64_t samples, std::int64_t rays) = nullptr;
  bool rounds = false;  ///< rows between layers are bf16, so an output can leave as MlpOut::rounded
};

}  // namespace semfield
