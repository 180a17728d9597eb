// The NeRF network on the device layer by layer: products of cuBLASLt and passes between them. Any shape, fp32 or bf16.
#pragma once

#include "fields/nerf_mlp/nerf_mlp_kernels.h"

namespace semfield::cuda {

/// Act: float, or __nv_bfloat16: activations in memory and operands of products; sums, heads, weights' gradients and
/// the direction's part of the view layer are fp32.
template <class Act>
struct LayeredNerfMlp {
  static void forward(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                      const FieldIn<float>& in, const FieldOut<float>& out, Saved saved);
  static void backward(const NerfMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                       const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                       View<float> d_position);
  static std::size_t saved_bytes(const NerfMlpShape& shape, std::int64_t samples);
};

}  // namespace semfield::cuda
