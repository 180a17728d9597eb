// What the fused kernels of the small network know of it.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "plugin/mlp/field.h"

namespace semfield {

/// What the semantic head reads.
enum class TinyFeature : std::uint8_t { hidden, geometry };

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

}  // namespace semfield
