// Shape, tensor numbering and kernel table of the small network.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "plugin/field.h"
#include "plugin/layer_weights.h"

namespace semfield {

class KernelTables;

/// What the semantic head reads.
enum class TinyFeature : std::uint8_t { hidden, geometry };

/// A layer's tensors; -1 = there is none.
struct TinyMlpLayer {
  int weight = -1, bias = -1;
  LayerWeight rows;  ///< on a CPU, those of what the samples bring: all but the direction's
};

struct TinyMlpShape {
  std::int32_t position_dims = 0;
  std::int32_t direction_dims = 0;
  std::int32_t hidden_width = 64;
  std::int32_t geometry_features = 15;
  std::int32_t color_width = 64;
  TinyFeature feature = TinyFeature::hidden;
  bool feature_only = false;  ///< `color` is empty, and `geometry` unless it is the feature
  bool direction_once = true;
  Precision precision = Precision::fp32;  ///< of the matrix products
  std::vector<TinyMlpLayer> hidden;       ///< position to last hidden activation
  TinyMlpLayer geometry;                  ///< to [sigma, geometry features]
  std::vector<TinyMlpLayer> color;        ///< [geometry features, direction] to last colour activation
  TinyMlpLayer rgb;

  bool has_direction() const { return direction_dims > 0; }
  bool has_geometry() const { return geometry.weight >= 0; }
  std::int32_t geometry_cols() const { return has_geometry() ? 1 + geometry_features : 0; }
  std::int32_t feature_dims() const { return feature == TinyFeature::hidden ? hidden_width : geometry_features; }
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
struct TinyMlpKernels {
  void (*forward)(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<Real>& tensors,
                  const FieldIn<Real>& in, const FieldOut<Real>& out, Saved saved) = nullptr;
  void (*backward)(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<Real>& tensors,
                   const FieldIn<Real>& in, const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved,
                   View<Real> d_position) = nullptr;
  void (*derive)(const TinyMlpShape& shape, const Tensors<Real>& tensors) = nullptr;
  std::size_t (*saved_bytes)(const TinyMlpShape& shape, std::int64_t samples) = nullptr;
  /// Null: FeatureForm::full.
  FeatureForm (*feature_form)(const TinyMlpShape& shape, std::int32_t hidden_width) = nullptr;
  /// Null: not planned ahead on this device.
  std::size_t (*scratch_bytes)(const TinyMlpShape& shape, std::int64_t samples, std::int64_t rays) = nullptr;
  /// Whether there are faster kernels, which do not take this shape. Null: never.
  bool (*slow)(const TinyMlpShape& shape) = nullptr;
};

void tiny_mlp_kernels(KernelTables& tables);

}  // namespace semfield
