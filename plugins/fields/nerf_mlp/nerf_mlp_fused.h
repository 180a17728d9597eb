// The NeRF network in its usual shape on Hopper: forward and backward each one kernel through all layers.
#pragma once

#include "fields/nerf_mlp/nerf_mlp_kernels.h"

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
