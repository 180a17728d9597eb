// CPU kernels of the small network: layers over one tile of samples that stays in cache. Each is written once for
// activations in the type of the sums and in bf16.
#include <algorithm>
#include <array>
#include <utility>

#include "compute/isa.h"
#include "compute/layers.h"
#include "core/check.h"
#include "fields/tiny_mlp/tiny_mlp_kernels.h"
#include "plugin/field_rows.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void tiny_mlp_cpu_kernels(KernelTables& tables);

namespace {

constexpr std::size_t kMaxLayers = 8;
template <class Act>
constexpr bool kRounds = std::is_same_v<Act, Bf16>;

/// What forward leaves. sigma and the geometry features are columns of one product; products of bf16 read features in
/// rows of their own.
template <class Act>
struct Activations {
  std::array<View<Act>, kMaxLayers> hidden;  // [M, hidden_width], after ReLU
  View<SumOf<Act>> geometry;                 // [M, 1 + G]: sigma and the geometry features; in bf16 only in forward
  View<Act> features;                        // [M, G]
  std::array<View<Act>, kMaxLayers> color;   // [M, color_width], after ReLU
};

template <class Act>
std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return s.hidden.size() * activation_bytes<Act>(samples, s.hidden_width) +
         activation_bytes<Act>(samples, kRounds<Act> && s.has_geometry() ? s.geometry_features : s.geometry_cols()) +
         s.color.size() * activation_bytes<Act>(samples, s.color_width);
}

/// The larger of what forward and backward take below.
template <class Act>
std::size_t scratch_bytes(const TinyMlpShape& s, std::int64_t samples, std::int64_t rays) {
  using Real = SumOf<Act>;
  ScratchSum sum, hidden, color;  // the two others take turns
  const auto rows = [&](ScratchSum& of, std::int32_t cols) {
    of.take<std::byte>(1, static_cast<std::int64_t>(activation_bytes<Act>(samples, cols)));
  };
  sum.take<Real>(samples, s.geometry_cols());
  for (int turn = 0; turn < 2; ++turn) rows(hidden, s.hidden_width);
  if (kRounds<Act>) {
    rows(sum, s.position_dims);
    rows(hidden, s.geometry_cols());
    hidden.take<Real>(samples, s.hidden_width);
  }
  if (s.feature_only) return sum.bytes() + hidden.bytes();
  color.take<Real>(samples, 3);
  if (kRounds<Act>) rows(color, 3);
  for (int turn = 0; turn < 2; ++turn) rows(color, s.color_width);
  if (s.has_direction() && s.direction_once) color.take<Real>(rays, s.color_width);
  if (s.has_direction() && !s.direction_once) {
    color.take<Real>(samples, s.direction_dims);
    if (kRounds<Act>) rows(color, s.direction_dims);
  }
  return sum.bytes() + std::max(hidden.bytes(), color.bytes());
}

/// One step's network and rows.
template <class Act>
struct Call {
  using Real = SumOf<Act>;
  const TinyMlpShape& s;
  const Tensors<Real>& t;
  const FieldIn<Real>& in;
  Workspace& arena;
  View<const Act> x;  // [M, position_dims]
  Activations<Act> a{};

  /// In `saved`, or, when no backward will follow, in the arena.
  Call(const TinyMlpShape& shape, const Tensors<Real>& tensors, const FieldIn<Real>& rows, Saved saved,
       Workspace& workspace)
      : s(shape), t(tensors), in(rows), arena(workspace), x(as_input<Act>(rows.position, workspace)) {
    const std::int64_t samples = in.position.rows;
    std::byte* at = saved.empty() ? arena.take_bytes(saved_bytes<Act>(s, samples)) : saved.data();
    const auto take = [&](std::int32_t cols) {
      const View<Act> view = activation_rows<Act>(at, samples, cols);
      at += activation_bytes<Act>(samples, cols);
      return view;
    };
    for (std::size_t i = 0; i < s.hidden.size(); ++i) a.hidden[i] = take(s.hidden_width);
    if constexpr (kRounds<Act>) {
      a.features = take(s.has_geometry() ? s.geometry_features : 0);
    } else {
      a.geometry = take(s.geometry_cols());
      a.features = a.geometry.col_range(1, s.geometry_features);
    }
    for (std::size_t i = 0; i < s.color.size(); ++i) a.color[i] = take(s.color_width);
  }

  View<Act> last_hidden() const { return a.hidden[s.hidden.size() - 1]; }
  View<Act> last_color() const { return a.color[s.color.size() - 1]; }
  /// y = x W + b, and the ReLU where y is an activation.
  Layer<Act> layer(const TinyMlpLayer& of, View<const Act> from) const {
    return {.x = from, .weight = forward_weight<Act>(of.rows, t), .start = value(t, of.bias)};
  }
  void hidden_layer(const TinyMlpLayer& of, View<const Act> from, View<Act> to) const {
    Layer<Act> call = layer(of, from);
    call.relu = true;
    call.y = to;
    apply(call);
  }
  /// The gradients of a layer's tensors.
  void gradients(const TinyMlpLayer& of, View<const Act> from, View<const Act> dz, bool with_bias = true) const {
    weight_gradient(from, dz, weight_grad(of.rows, t), with_bias ? grad_of(t, of.bias) : View<Real>());
  }
  /// dz W^T, to be finished.
  Layer<Act> back(const TinyMlpLayer& of, View<const Act> dz) const {
    return {.x = dz, .weight = backward_weight<Act>(of.rows, t)};
  }
  /// The same through the ReLU that made `after`.
  void back_through(const TinyMlpLayer& of, View<const Act> dz, View<const Act> after, View<Act> to) const {
    Layer<Act> call = back(of, dz);
    call.mask = after;
    call.y = to;
    apply(call);
  }
  /// Rows of the first colour layer's weight that the direction takes.
  View<const Real> direction_weight() const {
    return value(t, s.color[0].weight).row_range(s.geometry_features, s.direction_dims);
  }
};

template <class Act>
void color_forward(const Call<Act>& c, View<SumOf<Act>> rgb) {
  using Real = SumOf<Act>;
  const TinyMlpShape& s = c.s;
  Layer<Act> first = c.layer(s.color[0], c.a.features);
  first.relu = true;
  first.y = c.a.color[0];
  if (s.has_direction()) {
    const View<const Real> rows = s.direction_once ? c.in.direction : gather_directions(c.in, c.arena);
    const View<Real> sums = c.arena.template take<Real>(rows.rows, s.color_width);
    apply(Layer<Real>{.x = rows, .weight = c.direction_weight(), .start = first.start, .exact = sums});
    first.start = sums;
    if (s.direction_once) first.row_of = c.in.ray_of_sample;
  }
  apply(first);
  for (std::size_t i = 1; i < s.color.size(); ++i) c.hidden_layer(s.color[i], c.a.color[i - 1], c.a.color[i]);
  Layer<Act> last = c.layer(s.rgb, c.last_color());
  last.exact = rgb;
  apply(last);
  color_of_logits(rgb);
}

/// [sigma, geometry features] of every sample; in bf16 the features also as rows.
template <class Act>
void geometry_forward(Call<Act>& c) {
  if constexpr (kRounds<Act>) c.a.geometry = c.arena.template take<float>(c.x.rows, c.s.geometry_cols());
  Layer<Act> layer = c.layer(c.s.geometry, c.last_hidden());
  layer.exact = c.a.geometry;
  apply(layer);
  if constexpr (kRounds<Act>) round_rows(c.a.geometry.col_range(1, c.s.geometry_features), c.a.features);
}

template <class Act>
void forward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<SumOf<Act>>& t, const FieldIn<SumOf<Act>>& in,
             const FieldOut<SumOf<Act>>& out, Saved saved) {
  using Real = SumOf<Act>;
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(!s.feature_only || (out.sigma.empty() && out.rgb.empty()), "this network has its feature alone");
  const Workspace::Scope scope(*ctx.workspace);
  Call<Act> c(s, t, in, saved, *ctx.workspace);
  for (std::size_t i = 0; i < s.hidden.size(); ++i)
    c.hidden_layer(s.hidden[i], i == 0 ? c.x : View<const Act>(c.a.hidden[i - 1]), c.a.hidden[i]);
  const bool of_geometry = s.feature == TinyFeature::geometry;
  const bool wants_feature = !out.feature.empty() || !out.fused.feature.empty();
  if (!out.rgb.empty() || (wants_feature && of_geometry) || (kRounds<Act> && !out.sigma.empty())) {
    geometry_forward(c);
    if (!out.sigma.empty()) copy_rows<Real>(c.a.geometry.col_range(0, 1), out.sigma);
  } else if constexpr (!kRounds<Act>) {
    // A density query: one column of the product, the same chain of sums.
    if (!out.sigma.empty())
      apply(Layer<Real>{.x = c.last_hidden(),
                        .weight = value(t, s.geometry.weight).col_range(0, 1),
                        .start = value(t, s.geometry.bias).col_range(0, 1),
                        .exact = out.sigma});
  }
  if (!of_geometry) {
    hand_on_feature<Act>(c.last_hidden(), out);
  } else if (!out.feature.empty()) {
    copy_rows<Real>(c.a.geometry.col_range(1, s.geometry_features), out.feature);
  } else {
    hand_on_feature<Act>(c.a.features, out);
  }
  if (!out.rgb.empty()) color_forward(c, out.rgb);
}

/// From dL/d(rgb) to parameters and, assigned, to dL/d(geometry features).
template <class Act>
void color_backward(const Call<Act>& c, View<const SumOf<Act>> rgb, View<const SumOf<Act>> d_rgb,
                    View<SumOf<Act>> d_features) {
  using Real = SumOf<Act>;
  const TinyMlpShape& s = c.s;
  const Workspace::Scope scope(c.arena);
  const View<const Act> d_logit = as_input<Act>(logit_gradient(rgb, d_rgb, c.arena), c.arena);
  View<Act> dc = take_activations<Act>(c.arena, c.x.rows, s.color_width);
  View<Act> spare = take_activations<Act>(c.arena, c.x.rows, s.color_width);
  c.gradients(s.rgb, c.last_color(), d_logit);
  c.back_through(s.rgb, d_logit, c.last_color(), dc);
  for (std::size_t i = s.color.size() - 1; i > 0; --i) {
    c.gradients(s.color[i], c.a.color[i - 1], dc);
    c.back_through(s.color[i], dc, c.a.color[i - 1], spare);
    std::swap(dc, spare);
  }
  const View<Real> d_direction_weight =
      grad_of(c.t, s.color[0].weight).row_range(s.geometry_features, s.direction_dims);
  if (s.has_direction() && s.direction_once) {
    const View<Real> d_term = c.arena.template take<Real>(c.in.direction.rows, s.color_width);
    per_ray_sum(dc, c.in.ray_of_sample, d_term);
    weight_gradient(c.in.direction, d_term, d_direction_weight, grad_of(c.t, s.color[0].bias));
  } else if (s.has_direction()) {
    weight_gradient(as_input<Act>(gather_directions(c.in, c.arena), c.arena), dc, d_direction_weight, {});
  }
  c.gradients(s.color[0], c.a.features, dc, !(s.has_direction() && s.direction_once));
  Layer<Act> to_features = c.back(s.color[0], dc);
  to_features.exact = d_features;
  apply(to_features);
}

/// dL/d[sigma, geometry features] from whatever outputs have a gradient; false when all of it is zero.
template <class Act>
bool geometry_gradient(const Call<Act>& c, View<const SumOf<Act>> rgb, const FieldGrad<SumOf<Act>>& grad,
                       View<SumOf<Act>> d_out) {
  using Real = SumOf<Act>;
  const bool from_head = has_feature_gradient(grad) && c.s.feature == TinyFeature::geometry;
  if (grad.sigma.empty() && grad.rgb.empty() && !from_head) return false;
  const View<Real> d_features = d_out.col_range(1, c.s.geometry_features);
  if (grad.sigma.empty()) {
    fill(d_out.col_range(0, 1), Real(0));
  } else {
    copy_rows(grad.sigma, d_out.col_range(0, 1));
  }
  if (grad.rgb.empty()) {
    fill(d_features, Real(0));
  } else {
    color_backward(c, rgb, grad.rgb, d_features);
  }
  if (!from_head) return true;
  const Workspace::Scope scope(c.arena);
  View<const Real> of_head = grad.feature;
  if (of_head.empty()) {
    const View<Real> widened = c.arena.template take<Real>(d_features.rows, d_features.cols);
    take_feature_gradient(grad, widened);
    of_head = widened;
  }
  for (std::int64_t m = 0; m < d_features.rows; ++m) {
    for (std::int32_t i = 0; i < d_features.cols; ++i) d_features(m, i) += of_head(m, i);
  }
  return true;
}

template <class Act>
void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<SumOf<Act>>& t,
              const FieldIn<SumOf<Act>>& in, const FieldOut<SumOf<Act>>& out, const FieldGrad<SumOf<Act>>& grad,
              Saved saved, View<SumOf<Act>> d_position) {
  using Real = SumOf<Act>;
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const Call<Act> c(s, t, in, saved, arena);
  const View<Real> d_out = arena.take<Real>(c.x.rows, s.geometry_cols());
  const bool from_geometry = geometry_gradient(c, out.rgb, grad, d_out);
  const bool from_hidden = has_feature_gradient(grad) && s.feature == TinyFeature::hidden;
  if (!from_geometry && !from_hidden) {
    if (!d_position.empty()) fill(d_position, Real(0));
    return;
  }
  View<Act> dh = take_activations<Act>(arena, c.x.rows, s.hidden_width);
  View<Act> spare = take_activations<Act>(arena, c.x.rows, s.hidden_width);
  View<Real> sums;
  if (from_hidden) {
    sums = sums_before(dh, arena);
    take_feature_gradient(grad, sums);
  }
  if (from_geometry) {
    const View<const Act> dz = as_input<Act>(d_out, arena);
    c.gradients(s.geometry, c.last_hidden(), dz);
    Layer<Act> to_hidden = c.back(s.geometry, dz);
    to_hidden.start = sums;
    to_hidden.mask = c.last_hidden();
    to_hidden.y = dh;
    apply(to_hidden);
  } else {
    through_relu<Act>(c.last_hidden(), sums, dh);
  }
  for (std::size_t i = s.hidden.size() - 1; i > 0; --i) {
    c.gradients(s.hidden[i], c.a.hidden[i - 1], dh);
    c.back_through(s.hidden[i], dh, c.a.hidden[i - 1], spare);
    std::swap(dh, spare);
  }
  c.gradients(s.hidden[0], c.x, dh);
  if (d_position.empty()) return;
  Layer<Act> to_position = c.back(s.hidden[0], dh);
  to_position.exact = d_position;
  apply(to_position);
}

template <class Act>
void derive(const TinyMlpShape& s, const Tensors<SumOf<Act>>& t) {
  const auto rearranged = [&](const TinyMlpLayer& layer) {
    if (layer.weight >= 0) rearrange<Act>(layer.rows, t);
  };
  for (const TinyMlpLayer& layer : s.hidden) rearranged(layer);
  for (const TinyMlpLayer& layer : s.color) rearranged(layer);
  rearranged(s.geometry);
  rearranged(s.rgb);
}

FeatureForm feature_form(const TinyMlpShape& s, std::int32_t hidden_width) {
  return rounded_form(s.feature_dims(), hidden_width);
}

template <class Act>
constexpr TinyMlpKernels<SumOf<Act>> kTable{
    forward<Act>,       backward<Act>, derive<Act>, saved_bytes<Act>, kRounds<Act> ? feature_form : nullptr,
    scratch_bytes<Act>,
};

}  // namespace

void tiny_mlp_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<float>);
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<Bf16>, Precision::bf16);
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
