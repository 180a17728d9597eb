// Shape, tensor numbering and kernel table of the NeRF network.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "plugin/field.h"
#include "plugin/layer_weights.h"

namespace semfield {

class KernelTables;

/// A layer's tensors; -1 = there is none.
struct NerfMlpLayer {
  int weight = -1, bias = -1;
  LayerWeight position, activation;  ///< on a CPU, the rows that read each
};

/// What the kernels know. The widths of the tensors follow from it.
struct NerfMlpShape {
  std::int32_t position_dims = 0;
  std::int32_t direction_dims = 0;
  std::int32_t depth = 8;
  std::int32_t width = 256;
  std::int32_t skip_at = 5;  ///< 0: none
  std::int32_t view_width = 128;
  bool fold = true;  ///< feature and view layer as their product
  bool direction_once = true;
  Precision precision = Precision::fp32;  ///< of the matrix products
  std::vector<NerfMlpLayer> trunk;
  NerfMlpLayer density, feature, view, color;
  NerfMlpLayer folded;  ///< derived product of feature and view layer

  bool has_direction() const { return direction_dims > 0; }
  bool folds() const { return has_direction() && fold; }
  bool has_feature_activation() const { return has_direction() && !fold; }
};

/// The networks of a GPU's fused kernels, in bf16.
inline constexpr int kNerfFusedWidth = 256, kNerfFusedViewWidth = 128, kNerfFusedPosition = 64, kNerfFusedDepth = 15;
inline bool fused_takes(const NerfMlpShape& s) {
  return s.precision == Precision::bf16 && s.width == kNerfFusedWidth && s.view_width == kNerfFusedViewWidth &&
         s.position_dims <= kNerfFusedPosition && s.depth >= 2 && s.depth <= kNerfFusedDepth &&
         !s.has_feature_activation() && (!s.has_direction() || s.direction_once);
}
/// Why a GPU computes the network layer by layer, where it does.
std::string layer_by_layer(const NerfMlpShape& shape);

template <class Real>
struct NerfMlpKernels {
  void (*forward)(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<Real>& tensors,
                  const FieldIn<Real>& in, const FieldOut<Real>& out, Saved saved) = nullptr;
  void (*backward)(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<Real>& tensors,
                   const FieldIn<Real>& in, const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) = nullptr;
  void (*derive)(const NerfMlpShape& shape, const Tensors<Real>& tensors) = nullptr;
  void (*derive_backward)(const NerfMlpShape& shape, const Tensors<Real>& tensors) = nullptr;
  std::size_t (*saved_bytes)(const NerfMlpShape& shape, std::int64_t samples) = nullptr;
  /// Null: FeatureForm::full.
  FeatureForm (*feature_form)(const NerfMlpShape& shape, std::int32_t hidden_width) = nullptr;
  /// Null: not planned ahead on this device.
  std::size_t (*scratch_bytes)(const NerfMlpShape& shape, std::int64_t samples, std::int64_t rays) = nullptr;
  /// Whether there are faster kernels, which do not take this shape. Null: never.
  bool (*slow)(const NerfMlpShape& shape) = nullptr;
};

void nerf_mlp_kernels(KernelTables& tables);

}  // namespace semfield
