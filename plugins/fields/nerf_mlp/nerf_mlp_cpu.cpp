// CPU kernels of the NeRF network: layers over one tile of samples, nothing concatenated, nothing allocated. Each is
// written once for activations in the type of the sums and in bf16.
#include <array>
#include <utility>

#include "compute/isa.h"
#include "compute/layers.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "fields/nerf_mlp/nerf_mlp_kernels.h"
#include "plugin/field_rows.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void nerf_mlp_cpu_kernels(KernelTables& tables);

namespace {

constexpr int kMaxDepth = 32;

/// Activations that backward reads, all after their ReLU.
template <class Act>
struct Activations {
  std::array<View<Act>, kMaxDepth> trunk;
  View<Act> feature;  // [M, width], only when the feature layer is not folded
  View<Act> hidden;   // [M, view_width]

  View<Act> last(const NerfMlpShape& s) const { return trunk[static_cast<std::size_t>(s.depth - 1)]; }
};

template <class Act>
std::size_t saved_bytes(const NerfMlpShape& s, std::int64_t samples) {
  return static_cast<std::size_t>(s.depth + (s.has_feature_activation() ? 1 : 0)) *
             activation_bytes<Act>(samples, s.width) +
         activation_bytes<Act>(samples, s.view_width);
}

template <class Act>
Activations<Act> in_saved(const NerfMlpShape& s, std::int64_t samples, Saved saved) {
  std::byte* at = saved.data();
  const auto take = [&](std::int32_t cols) {
    const View<Act> view = activation_rows<Act>(at, samples, cols);
    at += activation_bytes<Act>(samples, cols);
    return view;
  };
  Activations<Act> a;
  for (int i = 0; i < s.depth; ++i) a.trunk[static_cast<std::size_t>(i)] = take(s.width);
  if (s.has_feature_activation()) a.feature = take(s.width);
  a.hidden = take(s.view_width);
  return a;
}

/// The larger of what forward and backward take below.
template <class Act>
std::size_t scratch_bytes(const NerfMlpShape& s, std::int64_t samples, std::int64_t rays) {
  using Real = SumOf<Act>;
  constexpr bool kRounds = std::is_same_v<Act, Bf16>;
  ScratchSum sum;
  const auto rows = [&](std::int32_t cols) {
    sum.take<std::byte>(1, static_cast<std::int64_t>(activation_bytes<Act>(samples, cols)));
  };
  for (int turn = 0; turn < 2; ++turn) rows(s.width);
  rows(s.view_width);
  sum.take<Real>(samples, 3);
  if (kRounds) {
    sum.take<Real>(samples, s.width);
    rows(s.position_dims);
    rows(1);
    rows(3);
  }
  if (s.has_direction() && s.direction_once) sum.take<Real>(rays, s.view_width);
  if (s.has_direction() && !s.direction_once) {
    sum.take<Real>(samples, s.direction_dims);
    if (kRounds) {
      rows(s.direction_dims);
      sum.take<Real>(samples, s.view_width);
    }
  }
  if (s.has_feature_activation()) rows(s.width);
  return sum.bytes();
}

/// Without a backward two trunk buffers take turns and stay in cache.
template <class Act>
Activations<Act> in_workspace(const NerfMlpShape& s, std::int64_t samples, bool with_color, Workspace& arena) {
  Activations<Act> a;
  const View<Act> turns[2] = {take_activations<Act>(arena, samples, s.width),
                              take_activations<Act>(arena, samples, s.width)};
  for (int i = 0; i < s.depth; ++i) a.trunk[static_cast<std::size_t>(i)] = turns[i % 2];
  if (!with_color) return a;
  if (s.has_feature_activation()) a.feature = take_activations<Act>(arena, samples, s.width);
  a.hidden = take_activations<Act>(arena, samples, s.view_width);
  return a;
}

/// One step's network and rows.
template <class Act>
struct Call {
  using Real = SumOf<Act>;
  const NerfMlpShape& s;
  const Tensors<Real>& t;
  const FieldIn<Real>& in;
  Workspace& arena;
  View<const Act> x{};  // [M, position_dims]
  Activations<Act> a{};

  auto forward(const LayerWeight& w) const { return forward_weight<Act>(w, t); }
  auto backward(const LayerWeight& w) const { return backward_weight<Act>(w, t); }
  /// The linear map between trunk (or feature) and the view layer's ReLU, and the input it reads.
  const NerfMlpLayer& view() const { return s.folds() ? s.folded : s.view; }
  View<Act> view_input() const { return s.has_feature_activation() ? a.feature : a.last(s); }
  View<const Real> direction_weight() const { return value(t, s.view.weight).row_range(s.width, s.direction_dims); }
};

template <class Act>
void trunk_forward(const Call<Act>& c) {
  using Real = SumOf<Act>;
  for (int i = 0; i < c.s.depth; ++i) {
    const auto n = static_cast<std::size_t>(i);
    const NerfMlpLayer& layer = c.s.trunk[n];
    View<const Real> start = value(c.t, layer.bias);
    const Workspace::Scope scope(c.arena);
    if (i > 0 && i == c.s.skip_at) {
      // [x, h] W = x W[0:Dp] + h W[Dp:]: two products instead of a copy.
      const View<Real> sums = sums_before(c.a.trunk[n], c.arena);
      apply(Layer<Act>{.x = c.x, .weight = c.forward(layer.position), .start = start, .exact = sums});
      start = sums;
    }
    apply(Layer<Act>{.x = i == 0 ? c.x : View<const Act>(c.a.trunk[n - 1]),
                     .weight = c.forward(i == 0 ? layer.position : layer.activation),
                     .start = start,
                     .relu = true,
                     .y = c.a.trunk[n]});
  }
}

template <class Act>
void color_forward(const Call<Act>& c, View<SumOf<Act>> rgb) {
  using Real = SumOf<Act>;
  const NerfMlpShape& s = c.s;
  if (s.has_feature_activation()) {
    apply(Layer<Act>{.x = c.a.last(s),
                     .weight = c.forward(s.feature.activation),
                     .start = value(c.t, s.feature.bias),
                     .y = c.a.feature});
  }
  Layer<Act> view{.x = c.view_input(),
                  .weight = c.forward(c.view().activation),
                  .start = value(c.t, c.view().bias),
                  .relu = true,
                  .y = c.a.hidden};
  if (s.has_direction() && s.direction_once) {
    const View<Real> ray_term = c.arena.template take<Real>(c.in.direction.rows, s.view_width);
    apply(Layer<Real>{.x = c.in.direction, .weight = c.direction_weight(), .start = view.start, .exact = ray_term});
    view.start = ray_term;
    view.row_of = c.in.ray_of_sample;
  } else if (s.has_direction()) {
    const View<Real> sums = c.arena.template take<Real>(c.x.rows, s.view_width);
    apply(Layer<Real>{
        .x = gather_directions(c.in, c.arena), .weight = c.direction_weight(), .start = view.start, .exact = sums});
    view.start = sums;
  }
  apply(view);
  apply(Layer<Act>{
      .x = c.a.hidden, .weight = c.forward(s.color.activation), .start = value(c.t, s.color.bias), .exact = rgb});
  color_of_logits(rgb);
}

template <class Act>
void forward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<SumOf<Act>>& t, const FieldIn<SumOf<Act>>& in,
             const FieldOut<SumOf<Act>>& out, Saved saved) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const std::int64_t samples = in.position.rows;
  Call<Act> c{s, t, in, arena};
  c.x = as_input<Act>(in.position, arena);
  c.a = saved.empty() ? in_workspace<Act>(s, samples, !out.rgb.empty(), arena) : in_saved<Act>(s, samples, saved);
  trunk_forward(c);
  if (!out.sigma.empty()) {
    apply(Layer<Act>{.x = c.a.last(s),
                     .weight = c.forward(s.density.activation),
                     .start = value(t, s.density.bias),
                     .exact = out.sigma});
  }
  hand_on_feature<Act>(c.a.last(s), out);
  if (!out.rgb.empty()) color_forward(c, out.rgb);
}

/// dh = dL/dh of the last trunk layer, before its ReLU, as the sum of what reads that layer.
template <class Act>
class TrunkGradient {
  using Real = SumOf<Act>;

 public:
  TrunkGradient(const Call<Act>& c, View<Act> dh) : after_(c.a.last(c.s)), dh_(dh), sums_(sums_before(dh, c.arena)) {}

  View<Real> begin() {
    start_ = sums_;
    return sums_;
  }
  /// Adds dz W^T of a layer that reads h; `last`: nothing follows.
  void add(View<const Act> dz, const typename LayerTypes<Act>::Weight& weight_t, bool last) {
    Layer<Act> layer{.x = dz, .weight = weight_t, .start = start_};
    if (last) {
      layer.mask = after_;
      layer.y = dh_;
    } else {
      layer.exact = sums_;
    }
    apply(layer);
    start_ = sums_;
  }
  void end() { through_relu<Act>(after_, sums_, dh_); }

 private:
  View<const Act> after_;
  View<Act> dh_;
  View<Real> sums_;
  View<const Real> start_;  // empty: zero so far
};

/// From dL/d(rgb) to parameters and to dh.
template <class Act>
void color_backward(const Call<Act>& c, View<const SumOf<Act>> rgb, View<const SumOf<Act>> d_rgb,
                    TrunkGradient<Act>& dh) {
  using Real = SumOf<Act>;
  const NerfMlpShape& s = c.s;
  const std::int64_t samples = c.x.rows;
  const View<const Act> d_logit = as_input<Act>(logit_gradient(rgb, d_rgb, c.arena), c.arena);
  const View<Act> dv = take_activations<Act>(c.arena, samples, s.view_width);
  weight_gradient(c.a.hidden, d_logit, weight_grad(s.color.activation, c.t), grad_of(c.t, s.color.bias));
  apply(Layer<Act>{.x = d_logit, .weight = c.backward(s.color.activation), .mask = c.a.hidden, .y = dv});

  View<Real> d_bias = grad_of(c.t, c.view().bias);
  const View<Real> d_direction_weight = grad_of(c.t, s.view.weight).row_range(s.width, s.direction_dims);
  if (s.has_direction() && s.direction_once) {
    const View<Real> d_term = c.arena.template take<Real>(c.in.direction.rows, s.view_width);
    per_ray_sum(dv, c.in.ray_of_sample, d_term);
    weight_gradient(c.in.direction, d_term, d_direction_weight, d_bias);
    d_bias = {};
  } else if (s.has_direction()) {
    weight_gradient(as_input<Act>(gather_directions(c.in, c.arena), c.arena), dv, d_direction_weight, {});
  }
  weight_gradient(c.view_input(), dv, weight_grad(c.view().activation, c.t), d_bias);
  if (!s.has_feature_activation()) return dh.add(dv, c.backward(c.view().activation), true);
  const View<Act> df = take_activations<Act>(c.arena, samples, s.width);
  apply(Layer<Act>{.x = dv, .weight = c.backward(s.view.activation), .y = df});
  weight_gradient(c.a.last(s), df, weight_grad(s.feature.activation, c.t), grad_of(c.t, s.feature.bias));
  dh.add(df, c.backward(s.feature.activation), true);
}

/// From dh (overwritten) to the trunk's parameters and the position.
template <class Act>
void trunk_backward(const Call<Act>& c, View<Act> dh, View<SumOf<Act>> d_position) {
  using Real = SumOf<Act>;
  const auto to_position = [&](const NerfMlpLayer& layer, View<const Real> start) {
    weight_gradient(c.x, dh, weight_grad(layer.position, c.t), {});
    if (d_position.empty()) return;
    apply(Layer<Act>{.x = dh, .weight = c.backward(layer.position), .start = start, .exact = d_position});
  };
  View<Act> spare = take_activations<Act>(c.arena, dh.rows, dh.cols);
  for (int i = c.s.depth - 1; i > 0; --i) {
    const auto n = static_cast<std::size_t>(i);
    const NerfMlpLayer& layer = c.s.trunk[n];
    if (i == c.s.skip_at) to_position(layer, {});
    weight_gradient(c.a.trunk[n - 1], dh, weight_grad(layer.activation, c.t), grad_of(c.t, layer.bias));
    apply(Layer<Act>{.x = dh, .weight = c.backward(layer.activation), .mask = c.a.trunk[n - 1], .y = spare});
    std::swap(dh, spare);
  }
  to_position(c.s.trunk[0], c.s.skip_at > 0 ? View<const Real>(d_position) : View<const Real>());
  weight_gradient(c.x, dh, {}, grad_of(c.t, c.s.trunk[0].bias));
}

template <class Act>
void backward(const NerfMlpShape& s, const StepContext& ctx, const Tensors<SumOf<Act>>& t,
              const FieldIn<SumOf<Act>>& in, const FieldOut<SumOf<Act>>& out, const FieldGrad<SumOf<Act>>& grad,
              Saved saved, View<SumOf<Act>> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  using Real = SumOf<Act>;
  const bool of_feature = has_feature_gradient(grad);
  if (grad.sigma.empty() && grad.rgb.empty() && !of_feature) {
    if (!d_position.empty()) fill(d_position, Real(0));
    return;
  }
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  Call<Act> c{s, t, in, arena};
  c.x = as_input<Act>(in.position, arena);
  c.a = in_saved<Act>(s, in.position.rows, saved);
  const View<Act> dh = take_activations<Act>(arena, in.position.rows, s.width);
  TrunkGradient<Act> sum(c, dh);
  if (of_feature) take_feature_gradient(grad, sum.begin());
  if (!grad.sigma.empty()) {
    const View<const Act> d_sigma = as_input<Act>(grad.sigma, arena);
    weight_gradient(c.a.last(s), d_sigma, weight_grad(s.density.activation, t), grad_of(t, s.density.bias));
    sum.add(d_sigma, c.backward(s.density.activation), grad.rgb.empty());
  }
  if (!grad.rgb.empty()) color_backward(c, out.rgb, grad.rgb, sum);
  if (grad.sigma.empty() && grad.rgb.empty()) sum.end();
  trunk_backward(c, dh, d_position);
}

template <class Act>
void derive(const NerfMlpShape& s, const Tensors<SumOf<Act>>& t) {
  using Real = SumOf<Act>;
  if (s.folds()) {
    // [f, d] W_v + b_v with f = h W_f + b_f: h (W_f W_vf) + d W_vd + (b_f W_vf + b_v), W_vf the first `width` rows of
    // W_v.
    const View<const Real> view_weight = value(t, s.view.weight).row_range(0, s.width);
    const auto folded = [&](int index) { return t.value[static_cast<std::size_t>(index)]; };
    apply(Layer<Real>{.x = value(t, s.feature.weight), .weight = view_weight, .exact = folded(s.folded.weight)});
    apply(Layer<Real>{.x = value(t, s.feature.bias),
                      .weight = view_weight,
                      .start = value(t, s.view.bias),
                      .exact = folded(s.folded.bias)});
  }
  std::array<const NerfMlpLayer*, kMaxDepth + 5> layers{};
  std::size_t count = 0;
  for (const NerfMlpLayer& layer : s.trunk) layers[count++] = &layer;
  for (const NerfMlpLayer* layer : {&s.density, &s.feature, &s.view, &s.color, &s.folded}) layers[count++] = layer;
  parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
    const NerfMlpLayer& layer = *layers[static_cast<std::size_t>(i)];
    const bool in_sums = s.folds() && &layer == &s.view;
    if (layer.position.weight >= 0) rearrange<Act>(layer.position, t);
    if (layer.activation.weight >= 0 && in_sums) rearrange<Real>(layer.activation, t);
    if (layer.activation.weight >= 0 && !in_sums) rearrange<Act>(layer.activation, t);
  });
}

/// Gradients of the product and its bias become those of the factors: dW_f += dP W_vf^T, dW_vf += W_f^T dP + b_f^T dp,
/// db_f += dp W_vf^T, db_v += dp.
template <class Real>
void derive_backward(const NerfMlpShape& s, const Tensors<Real>& t) {
  if (!s.folds() || t.grad.empty()) return;
  const View<const Real> d_product = grad_of(t, s.folded.weight), d_bias = grad_of(t, s.folded.bias);
  const View<const Real> view_weight_t = backward_weight<Real>(s.view.activation, t);
  const View<Real> d_view_weight = grad_of(t, s.view.weight).row_range(0, s.width);
  const auto factor = [&](int tensor, View<const Real> d_out, View<Real> d_view_bias) {
    const View<Real> d_factor = grad_of(t, tensor);
    weight_gradient(value(t, tensor), d_out, d_view_weight, d_view_bias);
    apply(Layer<Real>{.x = d_out, .weight = view_weight_t, .start = d_factor, .exact = d_factor});
  };
  factor(s.feature.weight, d_product, {});
  factor(s.feature.bias, d_bias, grad_of(t, s.view.bias));
}

FeatureForm feature_form(const NerfMlpShape& s, std::int32_t hidden_width) {
  return rounded_form(s.width, hidden_width);
}

template <class Act>
constexpr NerfMlpKernels<SumOf<Act>> kTable{
    forward<Act>,       backward<Act>,
    derive<Act>,        derive_backward<SumOf<Act>>,
    saved_bytes<Act>,   std::is_same_v<Act, Bf16> ? feature_form : nullptr,
    scratch_bytes<Act>,
};

}  // namespace

void nerf_mlp_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<float>);
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<Bf16>, Precision::bf16);
  tables.add(Device::cpu, "field 'nerf_mlp'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
