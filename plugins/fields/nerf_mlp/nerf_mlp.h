// The network of NeRF and Semantic-NeRF: a deep trunk on the encoded position, a density, and a colour that sees the
// direction.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "core/host_device.h"
#include "fields/nerf_mlp/nerf_mlp_kernels.h"

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
class NerfMlp final : public FusedMlpField<Real, NerfMlpShape> {
 public:
  NerfMlp(const NerfMlpParams& params, const FieldBuild& build, const KernelTables& kernels);
};

extern template class NerfMlp<float>;
extern template class NerfMlp<double>;

// Formulas of the NeRF network that are not matrix products.

/// d sigmoid(x) / dx from y = sigmoid(x): y (1 - y).
template <class Real>
SEMFIELD_HD inline Real nerf_mlp_sigmoid_slope(Real y) {
  return y * (Real(1) - y);
}

}  // namespace semfield
