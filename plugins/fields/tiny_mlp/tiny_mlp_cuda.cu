// CUDA kernels of the small network: fused in bf16 for the usual widths, and for a feature alone; layer by layer for
// all others.
#include "core/check.h"
#include "fields/tiny_mlp/tiny_mlp_feature.cuh"
#include "fields/tiny_mlp/tiny_mlp_fused.cuh"
#include "fields/tiny_mlp/tiny_mlp_layers.cuh"
#include "plugin/kernels.h"

namespace semfield::cuda {

void tiny_mlp_cuda_kernels(KernelTables& tables);

namespace {

void forward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  if (tiny::fused_applies(s)) {
    tiny::fused_forward(s, t, in, out);
  } else if (tiny::feature_applies(s)) {
    tiny::feature_forward(s, t, in.position, out.feature, saved);
  } else {
    tiny::layers_forward(s, ctx, t, in, out, saved);
  }
}

void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  if (tiny::fused_applies(s)) {
    tiny::fused_backward(s, *ctx.workspace, t, in, out.rgb, grad, d_position);
  } else if (tiny::feature_applies(s)) {
    tiny::feature_backward(s, *ctx.workspace, t, grad.feature, saved, d_position);
  } else {
    tiny::layers_backward(s, ctx, t, in, out, grad, saved, d_position);
  }
}

/// Nothing here reads the transposes.
void derive(const TinyMlpShape&, const Tensors<float>&) {}

std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  if (tiny::fused_applies(s)) return 0;
  return tiny::feature_applies(s) ? tiny::feature_saved_bytes(s, samples) : tiny::layers_saved_bytes(s, samples);
}

FeatureForm feature_form(const TinyMlpShape& s, std::int32_t) {
  return tiny::fused_applies(s) && tiny::shares_feature(s) ? FeatureForm::rounded : FeatureForm::full;
}

// In fp32 it is the precision that is slow.
bool slow(const TinyMlpShape& s) {
  return s.precision == Precision::bf16 && !tiny::fused_applies(s) && !tiny::feature_applies(s);
}

constexpr TinyMlpKernels<float> kTable{forward, backward, derive, saved_bytes, feature_form, nullptr, slow};

}  // namespace

void tiny_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'tiny_mlp'", &kTable);
  tables.add(Device::cuda, "field 'tiny_mlp'", &kTable, Precision::bf16);
}

}  // namespace semfield::cuda
