// Weights of the NeRF network as its products read them on the device.
#pragma once

#include <cuda_bf16.h>

#include <array>

#include "core/workspace.h"
#include "fields/nerf_mlp/nerf_mlp_kernels.h"

namespace semfield::cuda {

inline constexpr int kMaxDepth = 32;

/// Columns of an activation in memory: bf16 rows are padded with zeros to whole vectors of 16 bytes, which keeps every
/// product aligned.
template <class Act>
constexpr std::int32_t padded_cols(std::int32_t cols) {
  return sizeof(Act) == sizeof(float) ? cols : (cols + 7) / 8 * 8;
}

/// Matrices [padded in, padded out] and biases [1, padded out] of the layers that read activations; fp32: the tensors
/// themselves, bf16: rounded copies in the arena, made by one launch. Skip layer: trunk holds the part that reads
/// activations, skip the part that reads the position.
template <class Act>
struct NerfMlpWeights {
  std::array<View<const Act>, kMaxDepth> trunk, bias;
  View<const Act> skip;
  View<const Act> feature, feature_bias;  ///< unfolded
  View<const Act> view, view_bias;        ///< of the folded product, or of the view layer's part that reads the feature
  View<const Act> direction;              ///< the view layer's part that reads the direction; only if not once per ray
};

template <class Act>
NerfMlpWeights<Act> nerf_mlp_weights(const NerfMlpShape& shape, const Tensors<float>& tensors, Workspace& arena);

/// gathered [M, >= dims] = direction of each sample's ray, padding 0.
template <class Act>
void gather_directions(View<const float> direction, View<const std::int32_t> ray_of_sample, View<Act> gathered);

}  // namespace semfield::cuda
