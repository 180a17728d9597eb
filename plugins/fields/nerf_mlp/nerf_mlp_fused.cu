#include <type_traits>

#include "core/check.h"
#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "fields/nerf_mlp/nerf_mlp_fused.cuh"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"
#include "plugin/kernels.h"

namespace semfield::cuda {

namespace {

using Bf16 = __nv_bfloat16;
static_assert(fused::kMostLayers == fused::kMaxDepth);
static_assert(blocked_rows(1) == fused::kTileRows);

View<const float> value(const Tensors<float>& t, int index) { return t.value[static_cast<std::size_t>(index)]; }
View<float> grad_of(const Tensors<float>& t, int index) { return t.grad[static_cast<std::size_t>(index)]; }

std::int64_t blocks_for(std::int64_t samples) {
  return (samples + fused::kTileRows - 1) / fused::kTileRows * (fused::kTileRows / fused::kRows);
}

/// What forward leaves for backward, one part behind the other; null where there is no memory.
struct Kept {
  Bf16 *position = nullptr, *trunk = nullptr, *hidden = nullptr;
  uint4* trunk_mask = nullptr;
  uint2* hidden_mask = nullptr;
  std::size_t bytes = 0;

  Kept(const NerfMlpShape& s, std::int64_t blocks, std::byte* memory) {
    const auto take = [&](auto*& part, std::int64_t count) {
      using T = std::remove_reference_t<decltype(*part)>;
      part = memory == nullptr ? nullptr : reinterpret_cast<T*>(memory + bytes);
      bytes += static_cast<std::size_t>(count) * sizeof(T);  // a multiple of 256: whole tiles
    };
    const std::int64_t rows = blocks * fused::kRows;
    take(position, rows * fused::kPosition);
    take(trunk, s.depth * rows * fused::kWidth);
    take(hidden, rows * fused::kView);
    take(trunk_mask, s.depth * blocks * hopper::kWarpgroup);
    take(hidden_mask, blocks * hopper::kWarpgroup);
  }
};

/// The part of a trunk layer's weight that reads the layer below, or the position.
View<const float> of_layer_below(const NerfMlpShape& s, const Tensors<float>& t, int i) {
  const View<const float> weight = value(t, s.trunk[static_cast<std::size_t>(i)].weight);
  return i == s.skip_at ? weight.row_range(s.position_dims, s.width) : weight;
}
View<const float> view_weight(const NerfMlpShape& s, const Tensors<float>& t) {
  return s.folds() ? value(t, s.folded.weight) : value(t, s.view.weight);
}

/// semantic: weight of the semantic layer, or empty.
std::byte* forward_slabs(const NerfMlpShape& s, const Tensors<float>& t, bool with_color, View<const float> semantic,
                         Workspace& arena) {
  constexpr int kWhole = fused::kWidth / fused::kTerms;
  std::array<fused::Slabs, fused::kMostSlabs> all;
  int count = 0;
  const auto add = [&](View<const float> weight, int columns, int slabs) {
    all[static_cast<std::size_t>(count++)] = {weight, false, columns, slabs, {}};
  };
  for (int i = 0; i < s.depth; ++i) {
    const View<const float> weight = value(t, s.trunk[static_cast<std::size_t>(i)].weight);
    if (i == 0 || i == s.skip_at) add(weight.row_range(0, s.position_dims), fused::kWidth, 1);
    if (i > 0) add(of_layer_below(s, t, i), fused::kWidth, kWhole);
  }
  if (with_color) {
    add(view_weight(s, t), semantic.empty() ? fused::kView : fused::kView * 2, kWhole);
    all[static_cast<std::size_t>(count - 1)].beside = semantic;
  }
  std::byte* const slabs = arena.take_bytes(fused::slab_bytes(all, count));
  fused::pack_slabs(all, count, slabs);
  return slabs;
}

std::byte* backward_slabs(const NerfMlpShape& s, const Tensors<float>& t, bool with_color, View<const float> semantic,
                          Workspace& arena) {
  std::array<fused::Slabs, fused::kMostSlabs> all;
  int count = 0;
  const auto add = [&](View<const float> weight) {
    all[static_cast<std::size_t>(count++)] = {weight, true, fused::kWidth, weight.cols / fused::kTerms, {}};
  };
  if (!semantic.empty()) add(semantic);
  if (with_color) add(view_weight(s, t));
  for (int i = s.depth - 1; i > 0; --i) add(of_layer_below(s, t, i));
  std::byte* const slabs = arena.take_bytes(fused::slab_bytes(all, count));
  fused::pack_slabs(all, count, slabs);
  return slabs;
}

/// Whether rows can be read and written as pairs; else a matrix in the arena takes the view's place.
bool pairs(View<const float> m) {
  return m.row_stride % 2 == 0 && reinterpret_cast<std::uintptr_t>(m.data) % (2 * sizeof(float)) == 0;
}

void weights_backward(const NerfMlpShape& s, const Tensors<float>& t, const Kept& kept,
                      const fused::InputGradient& from, const HiddenLayer<float>& semantic, Workspace& arena) {
  const std::int64_t blocks = from.blocks, piece = blocks * fused::kRows * fused::kWidth;
  fused::WeightGradients call;
  const auto add = [&](fused::WeightGradient gradient) {
    if (gradient.blocks == 0) gradient.blocks = blocks;
    call.all[static_cast<std::size_t>(call.count++)] = gradient;
  };
  for (int i = 0; i < s.depth; ++i) {
    const View<float> d_weight = grad_of(t, s.trunk[static_cast<std::size_t>(i)].weight);
    View<float> d_bias = grad_of(t, s.trunk[static_cast<std::size_t>(i)].bias);
    const Bf16* const dz = from.d_trunk + i * piece;
    if (i > 0) {
      add({kept.trunk + (i - 1) * piece, dz, fused::kWidth, fused::kWidth,
           i == s.skip_at ? d_weight.row_range(s.position_dims, s.width) : d_weight, d_bias});
      d_bias = {};
    }
    if (i == 0 || i == s.skip_at) {
      add({kept.position, dz, fused::kPosition, fused::kWidth, d_weight.row_range(0, s.position_dims), d_bias});
    }
  }
  if (from.d_hidden != nullptr) {
    add({kept.trunk + (s.depth - 1) * piece, from.d_hidden, fused::kWidth, fused::kView,
         s.folds() ? grad_of(t, s.folded.weight) : grad_of(t, s.view.weight),
         s.has_direction() ? View<float>() : grad_of(t, s.view.bias)});
  }
  if (from.semantic_blocks > 0) {
    add({kept.trunk + (s.depth - 1) * piece, from.d_semantic, fused::kWidth, fused::kView, semantic.d_weight,
         semantic.d_bias, from.semantic_blocks});
  }
  fused::weight_gradients(call, arena);
}

void position_backward(const NerfMlpShape& s, const Tensors<float>& t, std::int64_t blocks, const Bf16* d_trunk,
                       View<float> d_position, Workspace& arena) {
  const Workspace::Scope scope(arena);
  const View<float> dz = arena.take<float>(d_position.rows, fused::kWidth);
  LinearBackward<float, float> layer;
  layer.dz = dz;
  layer.dx = d_position;
  for (int i = 0; i < s.depth; ++i) {
    if (i > 0 && i != s.skip_at) continue;
    fused::unpack(d_trunk + i * blocks * fused::kRows * fused::kWidth, dz);
    layer.weight = value(t, s.trunk[static_cast<std::size_t>(i)].weight).row_range(0, s.position_dims);
    layer.add_to_dx = i > 0;
    linear_backward(layer, arena);
  }
}

std::size_t saved_bytes(const NerfMlpShape& s, std::int64_t samples) {
  return Kept(s, blocks_for(samples), nullptr).bytes;
}

void forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
             const FieldOut<float>& out, Saved saved) {
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const bool with_color = !out.rgb.empty();
  fused::Forward call;
  call.rows = in.position.rows;
  call.blocks = blocks_for(call.rows);
  Kept kept(s, call.blocks, saved.empty() ? nullptr : saved.data());
  if (kept.position == nullptr) {
    kept.position = arena.take<Bf16>(call.blocks * fused::kRows, fused::kPosition).data;
  }
  fused::pack_position(in.position, call.blocks, kept.position);
  call.depth = s.depth;
  call.skip_at = s.skip_at;
  SEMFIELD_CHECK(out.fused.hidden.empty() || with_color, "the hidden layer is computed together with the colour");
  call.semantic = as_bf16(out.fused.hidden);
  if (!out.fused.hidden.empty()) call.semantic_bias = out.fused.layer.bias.data;
  call.weights =
      forward_slabs(s, t, with_color, out.fused.hidden.empty() ? View<const float>() : out.fused.layer.weight, arena);
  call.position = kept.position;
  for (std::size_t i = 0; i < s.trunk.size(); ++i) call.bias[i] = value(t, s.trunk[i].bias).data;
  call.density_weight = value(t, s.density.weight).data;
  call.density_bias = value(t, s.density.bias).data;
  call.color_weight = value(t, s.color.weight).data;
  call.color_bias = value(t, s.color.bias).data;
  call.trunk = kept.trunk;
  call.hidden = kept.hidden;
  call.trunk_mask = kept.trunk_mask;
  call.hidden_mask = kept.hidden_mask;
  call.sigma = out.sigma;
  call.rgb = out.rgb;
  call.feature = out.feature;
  if (with_color && s.has_direction()) {
    const View<float> ray_term = arena.take<float>(in.direction.rows, fused::kView);
    LinearForward<float, float> of_ray;
    of_ray.x = in.direction;
    of_ray.weight = value(t, s.view.weight).row_range(s.width, s.direction_dims);
    of_ray.bias = value(t, s.folds() ? s.folded.bias : s.view.bias);
    of_ray.y = ray_term;
    linear_forward(of_ray);
    call.ray_term = ray_term;
    call.ray_of_sample = in.ray_of_sample;
  } else {
    call.view_bias = value(t, s.view.bias).data;
  }
  call.rounded_feature = as_bf16(out.fused.feature);
  if (!out.feature.empty() && !pairs(out.feature)) call.feature = arena.take<float>(call.rows, fused::kWidth);
  fused::forward(call);
  if (call.feature.data != out.feature.data) convert<float, float>(call.feature, out.feature);
}

void backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
              const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved, View<float> d_position) {
  const View<const Bf16> d_rounded_feature = as_bf16(grad.fused.feature);
  const HiddenLayer<float>& semantic = out.fused.layer;
  const bool with_semantic = grad.fused.hidden != nullptr;
  if (grad.sigma.empty() && grad.rgb.empty() && grad.feature.empty() && d_rounded_feature.empty() && !with_semantic) {
    if (!d_position.empty()) cuda::fill(d_position, 0.0F);
    return;
  }
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const bool with_color = !grad.rgb.empty();
  fused::InputGradient call;
  call.rows = in.position.rows;
  call.blocks = blocks_for(call.rows);
  const std::int64_t rows = call.blocks * fused::kRows;
  const Kept kept(s, call.blocks, saved.data());
  call.depth = s.depth;
  call.weights = backward_slabs(s, t, with_color, with_semantic ? semantic.weight : View<const float>(), arena);
  call.density_weight = value(t, s.density.weight).data;
  call.color_weight = value(t, s.color.weight).data;
  call.trunk_mask = kept.trunk_mask;
  call.hidden_mask = kept.hidden_mask;
  call.d_sigma = grad.sigma;
  call.d_feature = grad.feature;
  call.d_rounded_feature = d_rounded_feature;
  if (!grad.feature.empty() && !pairs(grad.feature)) {
    const View<float> copy = arena.take<float>(call.rows, fused::kWidth);
    convert<float, float>(grad.feature, copy);
    call.d_feature = copy;
  }
  if (with_semantic) {
    call.d_semantic = as_bf16(grad.fused.hidden);
    call.semantic_blocks = blocked_rows(out.fused.hidden.rows) / fused::kRows;
  }
  call.d_trunk = arena.take<Bf16>(s.depth * rows, fused::kWidth).data;
  if (with_color) {
    call.rgb = out.rgb;
    call.d_rgb = grad.rgb;
    call.d_hidden = arena.take<Bf16>(rows, fused::kView).data;
  }
  fused::input_gradient(call);
  weights_backward(s, t, kept, call, semantic, arena);
  fused::HeadGradient density, color;
  if (!grad.sigma.empty()) {
    density.x = kept.trunk + (s.depth - 1) * rows * fused::kWidth;
    density.d = grad.sigma;
    density.d_weight = grad_of(t, s.density.weight);
    density.d_bias = grad_of(t, s.density.bias);
  }
  if (with_color) {
    color.x = kept.hidden;
    color.d = grad.rgb;
    color.y = out.rgb;
    color.d_weight = grad_of(t, s.color.weight);
    color.d_bias = grad_of(t, s.color.bias);
  }
  fused::head_gradients(density, color, arena);
  if (with_color && s.has_direction()) {
    const View<float> d_term = arena.take<float>(in.direction.rows, fused::kView);
    fused::per_ray_sums(call.d_hidden, in.ray_of_sample, d_term);
    LinearBackward<float, float> of_ray;
    of_ray.x = in.direction;
    of_ray.dz = d_term;
    of_ray.d_weight = grad_of(t, s.view.weight).row_range(s.width, s.direction_dims);
    of_ray.d_bias = grad_of(t, s.folds() ? s.folded.bias : s.view.bias);
    linear_backward(of_ray, arena);
  }
  if (!d_position.empty()) position_backward(s, t, call.blocks, call.d_trunk, d_position, arena);
}

FeatureForm feature_form(const NerfMlpShape&, std::int32_t hidden_width) {
  return hidden_width == fused::kView ? FeatureForm::hidden_layer : FeatureForm::rounded;
}

constexpr NerfMlpFused<float> kFused{nerf_mlp_is_fused, forward, backward, saved_bytes, feature_form};

}  // namespace

bool nerf_mlp_is_fused(const NerfMlpShape& s) {
  static const bool hopper = [] {
    int device = 0, major = 0, minor = 0;
    return cudaGetDevice(&device) == cudaSuccess &&
           cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device) == cudaSuccess &&
           cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device) == cudaSuccess && major == 9 &&
           minor == 0;
  }();
  static_assert(kNerfFusedWidth == fused::kWidth && kNerfFusedViewWidth == fused::kView);
  static_assert(kNerfFusedPosition == fused::kPosition && kNerfFusedDepth == fused::kMaxDepth);
  return hopper && fused_takes(s);
}

void nerf_mlp_cuda_kernels(KernelTables& tables) {
  tables.add(Device::cuda, "field 'nerf_mlp'", &kFused, Precision::bf16);
}

}  // namespace semfield::cuda
