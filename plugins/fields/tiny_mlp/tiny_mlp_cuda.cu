// The fused CUDA kernels of the small network as a table: in bf16 for the usual widths, and for a feature alone. Every
// other shape and fp32 are layers (plugin/mlp).
#include "core/check.h"
#include "fields/tiny_mlp/tiny_mlp_feature.cuh"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"
#include "plugin/kernels.h"
#include "plugin/mlp/fused_field.h"

namespace semfield::cuda {

void tiny_mlp_cuda_kernels(KernelTables& tables);

namespace {

bool serves(const TinyMlpShape& s) { return tiny::fused_applies(s) || tiny::feature_applies(s); }

void forward(const TinyMlpShape& s, const StepContext&, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  if (tiny::fused_applies(s)) return tiny::fused_forward(s, t, in, out);
  tiny::feature_forward(s, t, in.position, out.feature, saved);
}

void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  if (tiny::fused_applies(s)) {
    tiny::fused_backward(s, *ctx.workspace, t, in, out.rgb, grad, d_position);
  } else {
    tiny::feature_backward(s, *ctx.workspace, t, grad.feature, saved, d_position);
  }
}

std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return tiny::fused_applies(s) ? 0 : tiny::feature_saved_bytes(s, samples);
}

FeatureForm feature_form(const TinyMlpShape& s, std::int32_t) {
  return tiny::fused_applies(s) && tiny::shares_feature(s) ? FeatureForm::rounded : FeatureForm::full;
}

constexpr FusedFieldKernels<TinyMlpShape> kFused{serves, forward, backward, saved_bytes, feature_form};

}  // namespace

void tiny_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'tiny_mlp'", &kFused, Precision::bf16);
}

}  // namespace semfield::cuda
