// CUDA kernels of the NeRF network: tables, and the derived product of feature and view layer.
#include <cuda_bf16.h>

#include <array>

#include "cuda/matmul.h"
#include "fields/nerf_mlp/nerf_mlp_fused.h"
#include "fields/nerf_mlp/nerf_mlp_layered.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

void nerf_mlp_cuda_kernels(KernelTables& tables);

namespace {

View<const float> value(const Tensors<float>& t, int index) { return t.value[static_cast<std::size_t>(index)]; }
View<float> grad_of(const Tensors<float>& t, int index) { return t.grad[static_cast<std::size_t>(index)]; }

// [f, d] W_v + b_v with f = h W_f + b_f: h (W_f W_vf) + d W_vd + (b_f W_vf + b_v), W_vf the first `width` rows of W_v.
// The stored transposes stay as they are: products read a matrix either way.
void derive(const NerfMlpShape& s, const Tensors<float>& t) {
  if (!s.folds()) return;
  const View<const float> view_weight = value(t, s.view.weight).row_range(0, s.width);
  std::array<SmallProduct, 2> products;
  auto& [weight, bias] = products;
  weight.a = Matrix(value(t, s.feature.weight));
  weight.b = Matrix(view_weight);
  weight.d = t.value[static_cast<std::size_t>(s.folded.weight)];
  bias.a = Matrix(value(t, s.feature.bias));
  bias.b = Matrix(view_weight);
  bias.c = value(t, s.view.bias);
  bias.d = t.value[static_cast<std::size_t>(s.folded.bias)];
  small_products(products);
}

/// Gradients of the product and its bias become those of the factors: dW_f += dP W_vf^T, dW_vf += W_f^T dP + b_f^T dp,
/// db_f += dp W_vf^T, db_v += dp.
void derive_backward(const NerfMlpShape& s, const Tensors<float>& t) {
  if (!s.folds() || t.grad.empty()) return;
  const View<float> d_product = grad_of(t, s.folded.weight), d_bias = grad_of(t, s.folded.bias);
  const View<const float> view_weight = value(t, s.view.weight).row_range(0, s.width);
  std::array<SmallProduct, 4> products;
  auto& [feature_weight, view, feature_bias, view_bias] = products;
  feature_weight.a = Matrix(d_product);
  feature_weight.b = Matrix(view_weight, true);
  feature_weight.d = grad_of(t, s.feature.weight);
  view.a = Matrix(value(t, s.feature.weight), true);
  view.b = Matrix(d_product);
  view.a2 = Matrix(value(t, s.feature.bias), true);
  view.b2 = Matrix(d_bias);
  view.d = grad_of(t, s.view.weight).row_range(0, s.width);
  feature_bias.a = Matrix(d_bias);
  feature_bias.b = Matrix(view_weight, true);
  feature_bias.d = grad_of(t, s.feature.bias);
  view_bias.c = d_bias;
  view_bias.d = grad_of(t, s.view.bias);
  for (SmallProduct& p : products) p.add = true;
  small_products(products);
}

constexpr NerfMlpKernels<float> kFp32{LayeredNerfMlp<float>::forward, LayeredNerfMlp<float>::backward, derive,
                                      derive_backward, LayeredNerfMlp<float>::saved_bytes};

// bf16: the fused kernels where they serve, else layer by layer. A shape's answer never changes.
using Layered = LayeredNerfMlp<__nv_bfloat16>;

void forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  (FusedNerfMlp::serves(s) ? FusedNerfMlp::forward : Layered::forward)(s, ctx, t, in, out, saved);
}
void backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  (FusedNerfMlp::serves(s) ? FusedNerfMlp::backward : Layered::backward)(s, ctx, t, in, out, grad, saved, d_position);
}
std::size_t saved_bytes(const NerfMlpShape& s, std::int64_t samples) {
  return (FusedNerfMlp::serves(s) ? FusedNerfMlp::saved_bytes : Layered::saved_bytes)(s, samples);
}

FeatureForm feature_form(const NerfMlpShape& s, std::int32_t hidden_width) {
  return FusedNerfMlp::serves(s) && FusedNerfMlp::computes_layer(hidden_width) ? FeatureForm::hidden_layer
                                                                               : FeatureForm::rounded;
}

bool slow(const NerfMlpShape& s) { return !FusedNerfMlp::serves(s); }

constexpr NerfMlpKernels<float> kBf16{forward,     backward,     derive,  derive_backward,
                                      saved_bytes, feature_form, nullptr, slow};

}  // namespace

void nerf_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'nerf_mlp'", &kFp32);
  tables.add(Device::cuda, "field 'nerf_mlp'", &kBf16, Precision::bf16);
}

}  // namespace semfield::cuda
