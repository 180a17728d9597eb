#include <cuda_bf16.h>

#include <array>
#include <type_traits>
#include <utility>

#include "core/check.h"
#include "cuda/bf16.h"
#include "cuda/kernels/layers.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "fields/nerf_mlp/nerf_mlp_heads.cuh"
#include "fields/nerf_mlp/nerf_mlp_layered.h"
#include "fields/nerf_mlp/nerf_mlp_weights.cuh"

namespace semfield::cuda {

namespace {

/// What backward reads: activations after their ReLU, and for bf16 which of them are above 0.
template <class Act>
struct Activations {
  View<const Act> position;  ///< fp32: the input itself
  std::array<View<Act>, kMaxDepth> trunk;
  std::array<std::uint32_t*, kMaxDepth> mask{};
  View<Act> feature;  ///< [M, width], only when the feature layer is not folded
  View<Act> hidden;   ///< [M, view_width]
};

template <class Act>
constexpr bool kRounds = !std::is_same_v<Act, float>;

/// Hands out aligned parts of one piece of memory, or counts them.
class Parts {
 public:
  explicit Parts(std::byte* begin) : begin_(begin) {}
  template <class T>
  View<T> take(std::int64_t rows, std::int32_t cols) {
    const std::size_t at = used_;
    const std::size_t bytes = static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * sizeof(T);
    used_ += (bytes + kAlignment - 1) / kAlignment * kAlignment;
    return View<T>(begin_ == nullptr ? nullptr : reinterpret_cast<T*>(begin_ + at), rows, cols, cols, Device::cuda);
  }
  std::size_t used() const { return used_; }

 private:
  static constexpr std::size_t kAlignment = 256;
  std::byte* begin_;
  std::size_t used_ = 0;
};

template <class Act>
Activations<Act> in_saved(const NerfMlpShape& s, std::int64_t samples, Parts& parts) {
  Activations<Act> a;
  const std::int32_t width = padded_cols<Act>(s.width);
  const auto words = static_cast<std::int32_t>(mask_stride_bits(width) / 32);
  if constexpr (kRounds<Act>) a.position = parts.take<Act>(samples, padded_cols<Act>(s.position_dims));
  for (int i = 0; i < s.depth; ++i) {
    a.trunk[static_cast<std::size_t>(i)] = parts.take<Act>(samples, width);
    if constexpr (kRounds<Act>) {
      a.mask[static_cast<std::size_t>(i)] = parts.take<std::uint32_t>(samples, words).data;
    }
  }
  if (s.has_feature_activation()) a.feature = parts.take<Act>(samples, width);
  a.hidden = parts.take<Act>(samples, padded_cols<Act>(s.view_width));
  return a;
}

/// Without a backward two trunk buffers take turns.
template <class Act>
Activations<Act> in_workspace(const NerfMlpShape& s, std::int64_t samples, bool with_color, Workspace& arena) {
  Activations<Act> a;
  const std::int32_t width = padded_cols<Act>(s.width);
  if constexpr (kRounds<Act>) a.position = arena.take<Act>(samples, padded_cols<Act>(s.position_dims));
  const View<Act> turns[2] = {arena.take<Act>(samples, width), arena.take<Act>(samples, width)};
  for (int i = 0; i < s.depth; ++i) a.trunk[static_cast<std::size_t>(i)] = turns[i % 2];
  if (!with_color) return a;
  if (s.has_feature_activation()) a.feature = arena.take<Act>(samples, width);
  a.hidden = arena.take<Act>(samples, padded_cols<Act>(s.view_width));
  return a;
}

View<const float> value(const Tensors<float>& t, int index) { return t.value[static_cast<std::size_t>(index)]; }
View<float> grad_of(const Tensors<float>& t, int index) { return t.grad[static_cast<std::size_t>(index)]; }

void copy_rows(View<const __nv_bfloat16> from, View<__nv_bfloat16> to) {
  const auto bytes = [](std::int64_t numbers) { return sizeof(__nv_bfloat16) * static_cast<std::size_t>(numbers); };
  check(cudaMemcpy2DAsync(to.data, bytes(to.row_stride), from.data, bytes(from.row_stride), bytes(from.cols),
                          static_cast<std::size_t>(from.rows), cudaMemcpyDeviceToDevice, launch().stream),
        "copying a feature");
}

template <class Act>
void trunk_forward(const NerfMlpShape& s, const NerfMlpWeights<Act>& w, const Tensors<float>& t,
                   const Activations<Act>& a) {
  for (int i = 0; i < s.depth; ++i) {
    const auto n = static_cast<std::size_t>(i);
    LinearForward<Act, Act> layer;
    layer.y = a.trunk[n];
    layer.bias = value(t, s.trunk[n].bias);
    layer.rounded_bias = w.bias[n];
    if (i > 0 && i == s.skip_at) {
      // [x, h] W = x W[0:Dp] + h W[Dp:]: two products instead of a copy.
      layer.x = a.position;
      layer.weight = w.skip;
      linear_forward(layer);
      layer.bias = {};
      layer.rounded_bias = {};
      layer.add = true;
    }
    layer.x = i == 0 ? a.position : View<const Act>(a.trunk[n - 1]);
    layer.weight = w.trunk[n];
    layer.activation = Activation::relu;
    layer.mask = a.mask[n];
    linear_forward(layer);
  }
}

template <class Act>
void color_forward(const NerfMlpShape& s, Workspace& arena, const NerfMlpWeights<Act>& w, const Tensors<float>& t,
                   const FieldIn<float>& in, const Activations<Act>& a, View<float> rgb) {
  const View<const Act> h = a.trunk[static_cast<std::size_t>(s.depth - 1)];
  LinearForward<Act, Act> layer;
  if (s.has_feature_activation()) {
    layer.x = h;
    layer.weight = w.feature;
    layer.bias = value(t, s.feature.bias);
    layer.rounded_bias = w.feature_bias;
    layer.y = a.feature;
    linear_forward(layer);
    layer = {};
  }
  const View<const float> bias = value(t, s.folds() ? s.folded.bias : s.view.bias);
  layer.y = a.hidden;
  ColorHead<Act> head;
  if (s.has_direction() && s.direction_once) {
    const View<float> ray_term = arena.take<float>(in.direction.rows, s.view_width);
    LinearForward<float, float> of_ray;
    of_ray.x = in.direction;
    of_ray.weight = value(t, s.view.weight).row_range(s.width, s.direction_dims);
    of_ray.bias = bias;
    of_ray.y = ray_term;
    linear_forward(of_ray);
    head.ray_term = ray_term;
    head.ray_of_sample = in.ray_of_sample;
  } else {
    layer.activation = Activation::relu;
    layer.bias = bias;
    layer.rounded_bias = w.view_bias;
    if (s.has_direction()) {
      const View<Act> gathered = arena.take<Act>(in.position.rows, padded_cols<Act>(s.direction_dims));
      gather_directions<Act>(in.direction, in.ray_of_sample, gathered);
      LinearForward<Act, Act> of_direction = layer;
      of_direction.x = gathered;
      of_direction.weight = w.direction;
      of_direction.activation = Activation::none;
      linear_forward(of_direction);
      layer.bias = {};
      layer.rounded_bias = {};
      layer.add = true;
    }
  }
  layer.x = s.has_feature_activation() ? View<const Act>(a.feature) : h;
  layer.weight = w.view;
  linear_forward(layer);
  head.v = a.hidden;
  head.weight = value(t, s.color.weight);
  head.bias = value(t, s.color.bias);
  head.rgb = rgb;
  color_forward(head);
}

/// dv [M, view_width] = dL/d(view layer before its ReLU) to parameters and, added or assigned, to dh = dL/dh before h's
/// ReLU.
template <class Act>
void view_backward(const NerfMlpShape& s, Workspace& arena, const NerfMlpWeights<Act>& w, const Tensors<float>& t,
                   const FieldIn<float>& in, const Activations<Act>& a, View<const Act> dv,
                   LinearBackward<Act, Act> to_h) {
  const View<float> d_view = grad_of(t, s.view.weight);
  View<float> d_bias = grad_of(t, s.folds() ? s.folded.bias : s.view.bias);
  if (s.has_direction()) {
    const View<float> d_direction_weight = d_view.row_range(s.width, s.direction_dims);
    if (s.direction_once) {
      const View<float> d_term = arena.take<float>(in.direction.rows, s.view_width);
      cuda::per_ray_backward<Act>(dv, in.ray_of_sample, d_term);
      LinearBackward<float, float> of_ray;
      of_ray.x = in.direction;
      of_ray.dz = d_term;
      of_ray.d_weight = d_direction_weight;
      of_ray.d_bias = d_bias;
      linear_backward(of_ray, arena);
      d_bias = {};
    } else {
      const View<Act> gathered = arena.take<Act>(in.position.rows, padded_cols<Act>(s.direction_dims));
      gather_directions<Act>(in.direction, in.ray_of_sample, gathered);
      LinearBackward<Act, Act> of_direction;
      of_direction.x = gathered;
      of_direction.dz = dv;
      of_direction.d_weight = d_direction_weight;
      linear_backward(of_direction, arena);
    }
  }
  LinearBackward<Act, Act> of_view = to_h;
  of_view.dz = dv;
  of_view.weight = w.view;
  of_view.d_weight = s.folds() ? grad_of(t, s.folded.weight) : d_view.row_range(0, s.width);
  of_view.d_bias = d_bias;
  if (!s.has_feature_activation()) {
    linear_backward(of_view, arena);
    return;
  }
  const View<Act> d_feature = arena.take<Act>(dv.rows, padded_cols<Act>(s.width));
  of_view.x = a.feature;
  of_view.dx = d_feature;
  of_view.add_to_dx = false;
  of_view.relu_input = false;
  of_view.mask = nullptr;
  of_view.dx_sums = {};
  linear_backward(of_view, arena);
  to_h.dz = d_feature;
  to_h.weight = w.feature;
  to_h.d_weight = grad_of(t, s.feature.weight);
  to_h.d_bias = grad_of(t, s.feature.bias);
  linear_backward(to_h, arena);
}

/// The outputs' gradients to dh [M, width] = dL/d(last trunk layer before its ReLU), which it gives, and to the
/// parameters on the way.
template <class Act>
View<Act> heads_backward(const NerfMlpShape& s, Workspace& arena, const NerfMlpWeights<Act>& w, const Tensors<float>& t,
                         const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad,
                         const Activations<Act>& a) {
  const View<Act> dh = arena.take<Act>(in.position.rows, padded_cols<Act>(s.width));
  const auto last = static_cast<std::size_t>(s.depth - 1);
  const View<const Act> h = a.trunk[last];
  View<const Act> d_rounded_feature;
  if constexpr (kRounds<Act>) {
    d_rounded_feature = as_bf16(grad.fused.feature);
  }
  const bool with_density = !grad.sigma.empty() || !grad.feature.empty() || !d_rounded_feature.empty();
  if (with_density) {
    DensityHeadGrad<Act> density;
    density.h = h;
    density.weight = value(t, s.density.weight);
    density.d_sigma = grad.sigma;
    density.d_feature = grad.feature;
    density.d_rounded_feature = d_rounded_feature;
    density.d_weight = grad_of(t, s.density.weight);
    density.d_bias = grad_of(t, s.density.bias);
    density.dh = dh;
    density.masked = grad.rgb.empty();
    density_backward(density, arena);
  }
  if (grad.rgb.empty()) {
    add_column_sums<Act>(dh.col_range(0, s.width), grad_of(t, s.trunk[last].bias), arena);
    return dh;
  }
  const View<Act> dv = arena.take<Act>(h.rows, padded_cols<Act>(s.view_width));
  ColorHeadGrad<Act> color;
  color.v = a.hidden;
  color.weight = value(t, s.color.weight);
  color.rgb = out.rgb;
  color.d_rgb = grad.rgb;
  color.d_weight = grad_of(t, s.color.weight);
  color.d_bias = grad_of(t, s.color.bias);
  color.dv = dv;
  color_backward(color, arena);
  LinearBackward<Act, Act> to_h;
  to_h.x = h;
  to_h.dx = dh;
  to_h.add_to_dx = with_density;
  to_h.relu_input = true;
  to_h.mask = a.mask[last];
  to_h.dx_sums = grad_of(t, s.trunk[last].bias);
  view_backward<Act>(s, arena, w, t, in, a, dv, to_h);
  return dh;
}

template <class Act>
void trunk_backward(const NerfMlpShape& s, Workspace& arena, const NerfMlpWeights<Act>& w, const Tensors<float>& t,
                    const Activations<Act>& a, View<Act> dz, View<float> d_position) {
  View<Act> spare = arena.take<Act>(dz.rows, dz.cols);
  LinearBackward<Act, float> of_position;
  of_position.x = a.position;
  of_position.dx = d_position;
  for (int i = s.depth - 1; i > 0; --i) {
    const auto n = static_cast<std::size_t>(i);
    LinearBackward<Act, Act> layer;
    layer.x = a.trunk[n - 1];
    layer.dz = dz;
    layer.weight = w.trunk[n];
    layer.d_weight = grad_of(t, s.trunk[n].weight);
    layer.dx = spare;
    layer.dx_sums = grad_of(t, s.trunk[n - 1].bias);
    layer.relu_input = true;
    layer.mask = a.mask[n - 1];
    if (i == s.skip_at) {
      of_position.dz = dz;
      of_position.weight = w.skip.row_range(0, s.position_dims);
      of_position.d_weight = layer.d_weight.row_range(0, s.position_dims);
      linear_backward(of_position, arena);
      of_position.add_to_dx = true;
      layer.d_weight = layer.d_weight.row_range(s.position_dims, s.width);
    }
    linear_backward(layer, arena);
    std::swap(dz, spare);
  }
  of_position.dz = dz;
  of_position.weight = w.trunk[0].row_range(0, s.position_dims);
  of_position.d_weight = grad_of(t, s.trunk[0].weight);
  linear_backward(of_position, arena);
}

}  // namespace

template <class Act>
std::size_t LayeredNerfMlp<Act>::saved_bytes(const NerfMlpShape& s, std::int64_t samples) {
  Parts parts(nullptr);
  (void)in_saved<Act>(s, samples, parts);
  return parts.used();
}

template <class Act>
void LayeredNerfMlp<Act>::forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t,
                                  const FieldIn<float>& in, const FieldOut<float>& out, Saved saved) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  Parts parts(saved.data());
  Activations<Act> a = saved.empty() ? in_workspace<Act>(s, in.position.rows, !out.rgb.empty(), arena)
                                     : in_saved<Act>(s, in.position.rows, parts);
  if constexpr (kRounds<Act>) {
    const View<Act> rounded(const_cast<Act*>(a.position.data), a.position.rows, a.position.cols, -1, Device::cuda);
    convert<float, Act>(in.position, rounded);
  } else {
    a.position = in.position;
  }
  const NerfMlpWeights<Act> w = nerf_mlp_weights<Act>(s, t, arena);
  trunk_forward(s, w, t, a);
  DensityHead<Act> density;
  density.h = a.trunk[static_cast<std::size_t>(s.depth - 1)];
  density.weight = value(t, s.density.weight);
  density.bias = value(t, s.density.bias);
  density.sigma = out.sigma;
  density.feature = out.feature;
  density_forward(density);
  if constexpr (kRounds<Act>) {
    const View<const Act> h = density.h.col_range(0, s.width);
    if (!out.fused.feature.empty()) copy_rows(h, as_bf16(out.fused.feature));
  }
  if (!out.rgb.empty()) color_forward(s, arena, w, t, in, a, out.rgb);
}

template <class Act>
void LayeredNerfMlp<Act>::backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<float>& t,
                                   const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad,
                                   Saved saved, View<float> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  if (grad.sigma.empty() && grad.rgb.empty() && grad.feature.empty() && grad.fused.feature.empty()) {
    if (!d_position.empty()) cuda::fill(d_position, 0.0F);
    return;
  }
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  Parts parts(saved.data());
  Activations<Act> a = in_saved<Act>(s, in.position.rows, parts);
  if constexpr (!kRounds<Act>) a.position = in.position;
  const NerfMlpWeights<Act> w = nerf_mlp_weights<Act>(s, t, arena);
  const View<Act> dz = heads_backward<Act>(s, arena, w, t, in, out, grad, a);
  trunk_backward<Act>(s, arena, w, t, a, dz, d_position);
}

template struct LayeredNerfMlp<float>;
template struct LayeredNerfMlp<__nv_bfloat16>;

}  // namespace semfield::cuda
