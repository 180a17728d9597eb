// The fused CUDA kernels of the small network, as the field finds them: of the whole network in its usual widths, and
// of one that is asked for its hidden feature alone.
#include "fields/tiny_mlp/tiny_mlp_feature.cuh"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"
#include "plugin/kernels.h"

namespace semfield::cuda {

void tiny_mlp_cuda_kernels(KernelTables& tables);

namespace {

bool serve(const TinyMlpShape& s) { return tiny::fused_applies(s) || tiny::feature_applies(s); }

void forward(const TinyMlpShape& s, const StepContext&, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  if (tiny::fused_applies(s)) return tiny::fused_forward(s, t, in, out);
  tiny::feature_forward(s, t, in.position, out.feature, saved);
}

void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  if (tiny::fused_applies(s)) return tiny::fused_backward(s, *ctx.workspace, t, in, out.rgb, grad, d_position);
  tiny::feature_backward(s, *ctx.workspace, t, grad.feature, saved, d_position);
}

std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return tiny::fused_applies(s) ? 0 : tiny::feature_saved_bytes(s, samples);
}

FeatureForm feature_form(const TinyMlpShape& s, std::int32_t) {
  return tiny::fused_applies(s) && tiny::shares_feature(s) ? FeatureForm::rounded : FeatureForm::full;
}

constexpr TinyMlpFused<float> kFused{serve, forward, backward, saved_bytes, feature_form};

}  // namespace

void tiny_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'tiny_mlp'", &kFused, Precision::bf16);
}

}  // namespace semfield::cuda
