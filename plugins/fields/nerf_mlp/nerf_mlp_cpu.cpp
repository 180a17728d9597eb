// CPU kernels of the NeRF network: matrix products over one tile of samples, nothing concatenated, nothing allocated.
#include <array>
#include <string>

#include "compute/isa.h"
#include "compute/linear.h"
#include "compute/math_functions.h"
#include "core/check.h"
#include "fields/nerf_mlp/nerf_mlp_kernels.h"
#include "fields/nerf_mlp/nerf_mlp_math.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void nerf_mlp_cpu_kernels(KernelTables& tables);

namespace {

constexpr int kMaxDepth = 32;

std::size_t padded(std::int64_t rows, std::int32_t cols, std::size_t element) {
  return (static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * element + 63) / 64 * 64;
}

/// Activations that backward reads, all after their ReLU.
template <class Real>
struct Activations {
  std::array<View<Real>, kMaxDepth> trunk;
  View<Real> feature;  // [M, width], only when the feature layer is not folded
  View<Real> hidden;   // [M, view_width]
};

template <class Real>
std::size_t saved_bytes(const NerfMlpShape& s, std::int64_t samples) {
  return static_cast<std::size_t>(s.depth + (s.has_feature_activation() ? 1 : 0)) *
             padded(samples, s.width, sizeof(Real)) +
         padded(samples, s.view_width, sizeof(Real));
}

template <class Real>
Activations<Real> in_saved(const NerfMlpShape& s, std::int64_t samples, Saved saved) {
  std::byte* at = saved.data();
  const auto take = [&](std::int32_t cols) {
    const View<Real> view(reinterpret_cast<Real*>(at), samples, cols);
    at += padded(samples, cols, sizeof(Real));
    return view;
  };
  Activations<Real> a;
  for (int i = 0; i < s.depth; ++i) a.trunk[static_cast<std::size_t>(i)] = take(s.width);
  if (s.has_feature_activation()) a.feature = take(s.width);
  a.hidden = take(s.view_width);
  return a;
}

/// The larger of what forward and backward take below.
template <class Real>
std::size_t scratch_bytes(const NerfMlpShape& s, std::int64_t samples, std::int64_t rays) {
  ScratchSum sum;
  for (int turn = 0; turn < 2; ++turn) sum.take<Real>(samples, s.width);
  sum.take<Real>(samples, 3);
  sum.take<Real>(samples, s.view_width);
  if (s.has_direction() && s.direction_once) sum.take<Real>(rays, s.view_width);
  if (s.has_direction() && !s.direction_once) sum.take<Real>(samples, s.direction_dims);
  if (s.has_feature_activation()) sum.take<Real>(samples, s.width);
  return sum.bytes();
}

/// Without a backward two trunk buffers take turns and stay in cache.
template <class Real>
Activations<Real> in_workspace(const NerfMlpShape& s, std::int64_t samples, bool with_color, Workspace& arena) {
  Activations<Real> a;
  const View<Real> turns[2] = {arena.take<Real>(samples, s.width), arena.take<Real>(samples, s.width)};
  for (int i = 0; i < s.depth; ++i) a.trunk[static_cast<std::size_t>(i)] = turns[i % 2];
  if (!with_color) return a;
  if (s.has_feature_activation()) a.feature = arena.take<Real>(samples, s.width);
  a.hidden = arena.take<Real>(samples, s.view_width);
  return a;
}

template <class Real>
View<const Real> value(const Tensors<Real>& t, int index) {
  return t.value[static_cast<std::size_t>(index)];
}
template <class Real>
View<Real> grad_of(const Tensors<Real>& t, int index) {
  return t.grad[static_cast<std::size_t>(index)];
}

template <class Real>
LinearGrad<Real> gradients(const NerfMlpShape& s, const Tensors<Real>& t, const NerfMlpLayer& layer, View<Real> dx,
                           bool add_to_dx = false) {
  return {value(t, layer.weight_t), grad_of(t, layer.weight), grad_of(t, layer.bias), dx, add_to_dx, s.precision};
}

/// The linear map between trunk (or feature) and the view layer's ReLU, and the input it reads.
template <class Real>
struct ViewLayer {
  View<const Real> input;         // [M, width]
  View<const Real> weight, bias;  // [width, view_width], [1, view_width]
  View<const Real> weight_t;      // [view_width, width]
  View<Real> d_weight, d_bias;
  View<const Real> direction_weight;  // [direction_dims, view_width]
  View<Real> d_direction_weight;
};

template <class Real>
ViewLayer<Real> view_layer(const NerfMlpShape& s, const Tensors<Real>& t, const Activations<Real>& a, bool with_grad) {
  ViewLayer<Real> v;
  v.input = s.has_feature_activation() ? a.feature : a.trunk[static_cast<std::size_t>(s.depth - 1)];
  v.direction_weight = value(t, s.view.weight).row_range(s.width, s.direction_dims);
  if (s.folds()) {
    v.weight = value(t, s.folded.weight);
    v.bias = value(t, s.folded.bias);
    v.weight_t = value(t, s.folded.weight_t);
  } else {
    v.weight = value(t, s.view.weight).row_range(0, s.width);
    v.bias = value(t, s.view.bias);
    v.weight_t = value(t, s.view.weight_t).col_range(0, s.width);
  }
  if (with_grad) {
    v.d_direction_weight = grad_of(t, s.view.weight).row_range(s.width, s.direction_dims);
    v.d_weight = s.folds() ? grad_of(t, s.folded.weight) : grad_of(t, s.view.weight).row_range(0, s.width);
    v.d_bias = grad_of(t, s.folds() ? s.folded.bias : s.view.bias);
  }
  return v;
}

/// [M, direction_dims]: each sample's direction; only without the once-a-ray saving.
template <class Real>
View<Real> gather_directions(const FieldIn<Real>& in, Workspace& arena) {
  const View<Real> gathered = arena.take<Real>(in.position.rows, in.direction.cols);
  for (std::int64_t m = 0; m < gathered.rows; ++m) {
    const Real* from = in.direction.row(in.ray_of_sample(m, 0));
    for (std::int32_t c = 0; c < gathered.cols; ++c) gathered(m, c) = from[c];
  }
  return gathered;
}

template <class Real>
void trunk_forward(const NerfMlpShape& s, const Tensors<Real>& t, View<const Real> x, const Activations<Real>& a) {
  for (int i = 0; i < s.depth; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const View<const Real> weight = value(t, s.trunk[n].weight), bias = value(t, s.trunk[n].bias);
    if (i == 0) {
      linear_forward<Real>(x, weight, bias, Activation::relu, a.trunk[n], s.precision);
    } else if (i == s.skip_at) {
      // [x, h] W = x W[0:Dp] + h W[Dp:]: two products instead of a copy.
      linear_forward<Real>(x, weight.row_range(0, s.position_dims), bias, Activation::none, a.trunk[n], s.precision);
      linear_forward_add<Real>(a.trunk[n - 1], weight.row_range(s.position_dims, s.width), Activation::relu, a.trunk[n],
                               s.precision);
    } else {
      linear_forward<Real>(a.trunk[n - 1], weight, bias, Activation::relu, a.trunk[n], s.precision);
    }
  }
}

template <class Real>
void color_forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
                   const Activations<Real>& a, View<Real> rgb) {
  Workspace& arena = *ctx.workspace;
  if (s.has_feature_activation()) {
    linear_forward<Real>(a.trunk[static_cast<std::size_t>(s.depth - 1)], value(t, s.feature.weight),
                         value(t, s.feature.bias), Activation::none, a.feature, s.precision);
  }
  const ViewLayer<Real> v = view_layer(s, t, a, false);
  if (!s.has_direction()) {
    linear_forward(v.input, v.weight, v.bias, Activation::relu, a.hidden, s.precision);
  } else if (s.direction_once) {
    const View<Real> ray_term = arena.take<Real>(in.direction.rows, s.view_width);
    linear_forward(in.direction, v.direction_weight, v.bias, Activation::none, ray_term, s.precision);
    linear_forward_per_ray<Real>(v.input, v.weight, ray_term, in.ray_of_sample, Activation::relu, a.hidden,
                                 s.precision);
  } else {
    linear_forward<Real>(gather_directions(in, arena), v.direction_weight, v.bias, Activation::none, a.hidden,
                         s.precision);
    linear_forward_add(v.input, v.weight, Activation::relu, a.hidden, s.precision);
  }
  linear_forward<Real>(a.hidden, value(t, s.color.weight), value(t, s.color.bias), Activation::none, rgb, s.precision);
  if (rgb.contiguous()) {
    sigmoid_inplace(rgb.data, rgb.size());
  } else {
    for (std::int64_t m = 0; m < rgb.rows; ++m) sigmoid_inplace(rgb.row(m), rgb.cols);
  }
}

template <class Real>
void forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
             const FieldOut<Real>& out, Saved saved) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  const Workspace::Scope scope(*ctx.workspace);
  const std::int64_t samples = in.position.rows;
  const Activations<Real> a = saved.empty() ? in_workspace<Real>(s, samples, !out.rgb.empty(), *ctx.workspace)
                                            : in_saved<Real>(s, samples, saved);
  trunk_forward(s, t, in.position, a);
  const View<const Real> h = a.trunk[static_cast<std::size_t>(s.depth - 1)];
  if (!out.sigma.empty()) {
    linear_forward(h, value(t, s.density.weight), value(t, s.density.bias), Activation::none, out.sigma, s.precision);
  }
  if (!out.feature.empty()) copy_rows(h, out.feature);
  if (!out.rgb.empty()) color_forward(s, ctx, t, in, a, out.rgb);
}

/// From dL/d(rgb) to parameters and, added or assigned, to dh = dL/dh.
template <class Real>
void color_backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
                    View<const Real> rgb, View<const Real> d_rgb, const Activations<Real>& a, View<Real> dh) {
  Workspace& arena = *ctx.workspace;
  const std::int64_t samples = in.position.rows;
  const View<Real> d_logit = arena.take<Real>(samples, 3);
  for (std::int64_t m = 0; m < samples; ++m) {
    for (int c = 0; c < 3; ++c) d_logit(m, c) = d_rgb(m, c) * nerf_mlp_sigmoid_slope(rgb(m, c));
  }
  const View<Real> dv = arena.take<Real>(samples, s.view_width);
  linear_backward<Real>(a.hidden, d_logit, after_relu(gradients(s, t, s.color, dv)));

  const ViewLayer<Real> v = view_layer(s, t, a, true);
  View<Real> d_bias = v.d_bias;
  if (s.has_direction() && s.direction_once) {
    const View<Real> d_term = arena.take<Real>(in.direction.rows, s.view_width);
    per_ray_backward<Real>(dv, in.ray_of_sample, d_term);
    linear_backward<Real>(in.direction, d_term, {{}, v.d_direction_weight, v.d_bias, {}, false, s.precision});
    d_bias = {};
  } else if (s.has_direction()) {
    linear_backward<Real>(gather_directions(in, arena), dv, {{}, v.d_direction_weight, {}, {}, false, s.precision});
  }
  if (s.has_feature_activation()) {
    const View<Real> df = arena.take<Real>(samples, s.width);
    linear_backward<Real>(v.input, dv, {v.weight_t, v.d_weight, d_bias, df, false, s.precision});
    linear_backward<Real>(a.trunk[static_cast<std::size_t>(s.depth - 1)], df, gradients(s, t, s.feature, dh, true));
  } else {
    linear_backward<Real>(v.input, dv, {v.weight_t, v.d_weight, d_bias, dh, true, s.precision});
  }
}

/// From dh = dL/dh of the last trunk layer (overwritten) to the trunk's parameters and the position.
template <class Real>
void trunk_backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, View<const Real> x,
                    const Activations<Real>& a, View<Real> dh, View<Real> d_position) {
  View<Real> spare = ctx.workspace->take<Real>(dh.rows, dh.cols);
  relu_backward<Real>(a.trunk[static_cast<std::size_t>(s.depth - 1)], dh);
  for (int i = s.depth - 1; i > 0; --i) {
    const auto n = static_cast<std::size_t>(i);
    LinearGrad<Real> g = after_relu(gradients(s, t, s.trunk[n], spare));
    if (i == s.skip_at) {
      LinearGrad<Real> of_x{g.weight_t.col_range(0, s.position_dims),
                            g.d_weight.row_range(0, s.position_dims),
                            {},
                            d_position,
                            false,
                            s.precision};
      linear_backward<Real>(x, dh, of_x);
      g.weight_t = g.weight_t.col_range(s.position_dims, s.width);
      g.d_weight = g.d_weight.row_range(s.position_dims, s.width);
    }
    linear_backward<Real>(a.trunk[n - 1], dh, g);
    std::swap(dh, spare);
  }
  linear_backward<Real>(x, dh, gradients(s, t, s.trunk[0], d_position, s.skip_at > 0));
}

template <class Real>
void backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
              const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved, View<Real> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  if (grad.sigma.empty() && grad.rgb.empty() && grad.feature.empty()) {
    if (!d_position.empty()) fill(d_position, Real(0));
    return;
  }
  const Workspace::Scope scope(*ctx.workspace);
  const Activations<Real> a = in_saved<Real>(s, in.position.rows, saved);
  const View<Real> dh = ctx.workspace->take<Real>(in.position.rows, s.width);
  if (grad.feature.empty()) {
    fill(dh, Real(0));
  } else {
    copy_rows(grad.feature, dh);
  }
  if (!grad.sigma.empty()) {
    linear_backward<Real>(a.trunk[static_cast<std::size_t>(s.depth - 1)], grad.sigma,
                          gradients(s, t, s.density, dh, true));
  }
  if (!grad.rgb.empty()) color_backward<Real>(s, ctx, t, in, out.rgb, grad.rgb, a, dh);
  trunk_backward(s, ctx, t, in.position, a, dh, d_position);
}

template <class Real>
void derive(const NerfMlpShape& s, const Tensors<Real>& t) {
  const auto derived = [&](int index) { return t.value[static_cast<std::size_t>(index)]; };
  if (s.folds()) {
    // [f, d] W_v + b_v with f = h W_f + b_f: h (W_f W_vf) + d W_vd + (b_f W_vf + b_v), W_vf the first `width` rows of
    // W_v.
    const View<const Real> view_weight = value(t, s.view.weight).row_range(0, s.width);
    linear_forward<Real>(value(t, s.feature.weight), view_weight, {}, Activation::none, derived(s.folded.weight));
    linear_forward<Real>(value(t, s.feature.bias), view_weight, value(t, s.view.bias), Activation::none,
                         derived(s.folded.bias));
  }
  const auto transposed = [&](const NerfMlpLayer& layer) {
    if (layer.weight_t >= 0) transpose(value(t, layer.weight), derived(layer.weight_t));
  };
  for (const NerfMlpLayer& layer : s.trunk) transposed(layer);
  for (const NerfMlpLayer* layer : {&s.density, &s.feature, &s.view, &s.color, &s.folded}) transposed(*layer);
}

/// Gradients of the product and its bias become those of the factors: dW_f += dP W_vf^T, dW_vf += W_f^T dP + b_f^T dp,
/// db_f += dp W_vf^T, db_v += dp.
template <class Real>
void derive_backward(const NerfMlpShape& s, const Tensors<Real>& t) {
  if (!s.folds() || t.grad.empty()) return;
  const View<const Real> d_product = grad_of(t, s.folded.weight), d_bias = grad_of(t, s.folded.bias);
  const View<const Real> view_weight_t = value(t, s.view.weight_t).col_range(0, s.width);
  const View<Real> d_view_weight = grad_of(t, s.view.weight).row_range(0, s.width);
  linear_backward<Real>(value(t, s.feature.weight), d_product,
                        {view_weight_t, d_view_weight, {}, grad_of(t, s.feature.weight), true});
  linear_backward<Real>(value(t, s.feature.bias), d_bias,
                        {view_weight_t, d_view_weight, grad_of(t, s.view.bias), grad_of(t, s.feature.bias), true});
}

template <class Real>
constexpr NerfMlpKernels<Real> kTable{forward<Real>,     backward<Real>, derive<Real>,       derive_backward<Real>,
                                      saved_bytes<Real>, nullptr,        scratch_bytes<Real>};

}  // namespace

void nerf_mlp_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<float>);
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<float>, Precision::bf16);
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
