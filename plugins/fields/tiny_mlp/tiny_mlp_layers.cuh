// The small network layer by layer, for every width and depth: activations of a batch in device memory. The twin of
// tiny_mlp_cpu.cpp.
#pragma once

#include "fields/tiny_mlp/tiny_mlp_kernels.h"

namespace semfield::cuda::tiny {

std::size_t layers_saved_bytes(const TinyMlpShape& shape, std::int64_t samples);
void layers_forward(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                    const FieldIn<float>& in, const FieldOut<float>& out, Saved saved);
void layers_backward(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                     const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                     View<float> d_position);

}  // namespace semfield::cuda::tiny
