// What the fused kernels of the NeRF network know of it.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "plugin/mlp/field.h"

namespace semfield {

/// The widths of the tensors follow from it.
struct NerfMlpShape {
  std::int32_t position_dims = 0;
  std::int32_t direction_dims = 0;
  std::int32_t depth = 8;
  std::int32_t width = 256;
  std::int32_t skip_at = 5;  ///< 0: none
  std::int32_t view_width = 128;
  bool feature_only = false;  ///< a semantic branch: the trunk alone
  bool fold = true;           ///< feature and view layer as their product
  bool direction_once = true;
  Precision precision = Precision::fp32;  ///< of the matrix products
  std::vector<LayerTensors> trunk{};
  LayerTensors density{}, view{}, color{};
  LayerTensors folded{};  ///< derived product of feature and view layer

  bool has_direction() const { return direction_dims > 0; }
  bool folds() const { return has_direction() && fold; }
};

/// The networks of a GPU's fused kernels, in bf16.
inline constexpr int kNerfFusedWidth = 256, kNerfFusedViewWidth = 128, kNerfFusedPosition = 64, kNerfFusedDepth = 15;
inline bool fused_takes(const NerfMlpShape& s) {
  return s.precision == Precision::bf16 && !s.feature_only && s.width == kNerfFusedWidth &&
         s.view_width == kNerfFusedViewWidth && s.position_dims <= kNerfFusedPosition && s.depth >= 2 &&
         s.depth <= kNerfFusedDepth && (!s.has_direction() || (s.fold && s.direction_once));
}
/// Why a GPU computes the network layer by layer, where it does.
std::string layer_by_layer(const NerfMlpShape& shape);

template <class Real>
using NerfMlpFused = FusedKernels<Real, NerfMlpShape>;

}  // namespace semfield

// The network in its usual shape on Hopper: forward and backward each one kernel through all layers.

namespace semfield::cuda {

/// The same function and tensors as the network layer by layer, for the shapes that `serves` names.
struct FusedNerfMlp {
  /// Whether shape and GPU have these kernels: bf16, 256 wide, view layer 128 wide, encoded position of at most
  /// 64 numbers, depth 2 to 15, direction once per ray and feature layer folded (or no direction); compute
  /// capability 9.0.
  static bool serves(const NerfMlpShape& shape);
  /// Whether they compute a semantic hidden layer of that many numbers.
  static bool computes_layer(std::int32_t hidden_width);

  static void forward(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                      const FieldIn<float>& in, const FieldOut<float>& out, Saved saved);
  static void backward(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                       const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                       View<float> d_position);
  static std::size_t saved_bytes(const NerfMlpShape& shape, std::int64_t samples);
};

}  // namespace semfield::cuda
