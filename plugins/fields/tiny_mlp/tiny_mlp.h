// The small network behind a learned encoding: one hidden layer to density and geometry features, two to colour.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "plugin/mlp/field.h"

namespace semfield {

/// What the semantic head reads.
enum class TinyFeature : std::uint8_t { hidden, geometry };

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

// What the fused kernels of a GPU know of the network.

struct TinyMlpShape {
  std::int32_t position_dims = 0;
  std::int32_t direction_dims = 0;
  std::int32_t hidden_width = 64;
  std::int32_t geometry_features = 15;
  std::int32_t color_width = 64;
  TinyFeature feature = TinyFeature::hidden;
  bool feature_only = false;              ///< a semantic branch, without `color`
  Precision precision = Precision::fp32;  ///< of the matrix products
  std::vector<LayerTensors> hidden{};     ///< position to last hidden activation
  LayerTensors geometry{};                ///< to [sigma, geometry features]
  std::vector<LayerTensors> color{};      ///< [geometry features, direction] to last colour activation
  LayerTensors rgb{};

  bool has_direction() const { return direction_dims > 0; }
};

/// The largest networks of a GPU's fused kernels, in bf16: of the whole network, and of one that is asked for its
/// hidden feature alone.
inline constexpr int kTinyFusedWidth = 64, kTinyFusedPosition = 64, kTinyFusedDirection = 16, kTinyFusedGeometry = 15;
inline constexpr int kTinyFusedFeatureWidth = 128, kTinyFusedFeatureLayers = 4;

inline bool fused_takes(const TinyMlpShape& s) {
  return s.precision == Precision::bf16 && s.hidden.size() == 1 && s.color.size() == 2 &&
         s.hidden_width <= kTinyFusedWidth && s.color_width <= kTinyFusedWidth &&
         s.geometry_features <= kTinyFusedGeometry && s.position_dims <= kTinyFusedPosition &&
         s.direction_dims <= kTinyFusedDirection;
}
inline bool fused_takes_feature(const TinyMlpShape& s) {
  return s.feature_only && s.feature == TinyFeature::hidden && s.precision == Precision::bf16 &&
         s.hidden.size() <= kTinyFusedFeatureLayers && s.hidden_width <= kTinyFusedFeatureWidth &&
         s.position_dims <= kTinyFusedFeatureWidth;
}
/// Why a GPU computes the network layer by layer, where it does.
std::string layer_by_layer(const TinyMlpShape& shape);

template <class Real>
using TinyMlpFused = FusedKernels<Real, TinyMlpShape>;

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

}  // namespace semfield
