// A network that is asked for its hidden feature alone, such as a semantic branch: hidden layers up to 128 wide and
// positions up to 128 numbers in bf16, all layers in one kernel a direction. Forward keeps what each layer read, 2
// bytes per number; weight gradients of all layers are another kernel over these, since a wide network's sums would not
// stay in a block's registers.
#pragma once

#include "fields/tiny_mlp/tiny_mlp_tile.cuh"

namespace semfield::cuda::tiny {

inline constexpr int kMostFeatureLayers = kTinyFusedFeatureLayers;
inline constexpr int kMostFeatureWidth = kTinyFusedFeatureWidth;  // and numbers of a position

/// Whether these kernels compute this network on the current device.
bool feature_applies(const TinyMlpShape& shape);
std::size_t feature_saved_bytes(const TinyMlpShape& shape, std::int64_t samples);
void feature_forward(const TinyMlpShape& shape, const Tensors<float>& tensors, View<const float> position,
                     View<float> feature, Saved saved);
/// What forward saved of the same rows -> gradients of the tensors and, where it is not empty, of the position.
void feature_backward(const TinyMlpShape& shape, Workspace& arena, const Tensors<float>& tensors,
                      View<const float> d_feature, Saved saved, View<float> d_position);

/// The hidden layers' tensors [in, out], [1, out], or their gradients.
template <class T>
struct LayersOf {
  View<T> weight[kMostFeatureLayers], bias[kMostFeatureLayers];
  int count = 0;
};

/// Columns of a matrix in whole groups.
__host__ __device__ constexpr int padded_columns(int columns) { return (columns + kGroup - 1) / kGroup * kGroup; }

/// Rows that the layers read: layer l's input [M, padded_columns], rounded, the last one the feature itself.
struct Activations {
  __nv_bfloat16* position = nullptr;  ///< null: nothing is kept
  __nv_bfloat16* hidden = nullptr;    ///< [layers, M, width]
  std::int64_t rows = 0;
  int position_columns = 0, width = 0;
  __host__ __device__ __nv_bfloat16* layer(int l) const { return hidden + l * rows * width; }
};

/// d_weight += x^T dz and d_bias += column sums of dz for every layer, over the rows before *live; dz as
/// Activations::hidden. Sums over fixed ranges of rows are added in order: same bits in every run.
void feature_weight_gradients(const LayersOf<float>& d, const Activations& x, const __nv_bfloat16* dz,
                              const std::int32_t* live, Workspace& arena);

}  // namespace semfield::cuda::tiny
