// The small network behind a learned encoding: one hidden layer to density and geometry features, two to colour.
#pragma once

#include "config/params.h"
#include "core/error.h"
#include "core/host_device.h"
#include "fields/tiny_mlp/tiny_mlp_kernels.h"

namespace semfield {

struct TinyMlpParams {
  int hidden_width = 64;
  int hidden_layers = 1;
  int geometry_features = 15;
  int color_width = 64;
  int color_layers = 2;
  TinyFeature feature = TinyFeature::hidden;
};

SEMFIELD_CHOICES(TinyFeature, "hidden", "geometry");

void describe(ParamVisitor& visit, TinyMlpParams& params);
void validate(const TinyMlpParams& params, Diagnostics& diagnostics);

/// [Mueller22 Sec. 5.4], with biases. Weights are [in, out]; x encoded position, d encoded direction:
///   h = relu(... relu(x W_hidden_0 + b) ...); [sigma, g] = h W_geometry + b;
///   c = relu(... relu([g, d] W_color_0 + b) ...); rgb = sigmoid(c W_rgb + b).
/// The semantic head reads h (feature: hidden) or g (feature: geometry). Without a direction c sees g alone.
/// Exact saving direction_once_per_ray: d W_color_0[G:] + b is a row per ray.
template <class Real>
class TinyMlp final : public FusedMlpField<Real, TinyMlpShape> {
 public:
  TinyMlp(const TinyMlpParams& params, const FieldBuild& build, const KernelTables& kernels);
};

extern template class TinyMlp<float>;
extern template class TinyMlp<double>;

// Formulas of the small network that are not matrix products.

/// d sigmoid(x) / dx from y = sigmoid(x): y (1 - y).
template <class Real>
SEMFIELD_HD inline Real tiny_mlp_sigmoid_slope(Real y) {
  return y * (Real(1) - y);
}

}  // namespace semfield
