// The network of NeRF and Semantic-NeRF: a deep trunk on the encoded position, a density, and a colour that sees the
// direction.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "plugin/mlp/field.h"

namespace semfield {

struct NerfMlpParams {
  int depth = 8;
  int width = 256;
  int skip_at = 5;
  int view_width = 128;
};

void describe(ParamVisitor& visit, NerfMlpParams& params);
void validate(const NerfMlpParams& params, Diagnostics& diagnostics);

// What the fused kernels of a GPU know of the network.

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
class NerfMlp final : public FusedMlpField<Real, NerfMlpShape> {
 public:
  NerfMlp(const NerfMlpParams& params, const FieldBuild& build, const KernelTables& kernels);
};

extern template class NerfMlp<float>;
extern template class NerfMlp<double>;

namespace cuda {
/// Whether shape and GPU have fused kernels: fused_takes() and compute capability 9.0.
bool nerf_mlp_is_fused(const NerfMlpShape& shape);
}  // namespace cuda

}  // namespace semfield
