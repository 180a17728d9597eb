// CPU kernels of the small network: matrix products over one tile of samples that stays in cache.
#include <algorithm>
#include <array>
#include <utility>

#include "compute/isa.h"
#include "compute/linear.h"
#include "compute/math_functions.h"
#include "core/check.h"
#include "fields/tiny_mlp/tiny_mlp_kernels.h"
#include "fields/tiny_mlp/tiny_mlp_math.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void tiny_mlp_cpu_kernels(KernelTables& tables);

namespace {

constexpr std::size_t kMaxLayers = 8;

std::size_t padded(std::int64_t rows, std::int32_t cols, std::size_t element) {
  return (static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * element + 63) / 64 * 64;
}

/// Activations that backward reads.
template <class Real>
struct Activations {
  std::array<View<Real>, kMaxLayers> hidden;  // [M, hidden_width], after ReLU
  View<Real> geometry;                        // [M, 1 + G]: sigma and the geometry features
  std::array<View<Real>, kMaxLayers> color;   // [M, color_width], after ReLU

  View<Real> features(const TinyMlpShape& s) const { return geometry.col_range(1, s.geometry_features); }
};

template <class Real>
std::size_t saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return s.hidden.size() * padded(samples, s.hidden_width, sizeof(Real)) +
         padded(samples, s.geometry_cols(), sizeof(Real)) +
         s.color.size() * padded(samples, s.color_width, sizeof(Real));
}

/// The larger of what forward and backward take below.
template <class Real>
std::size_t scratch_bytes(const TinyMlpShape& s, std::int64_t samples, std::int64_t rays) {
  ScratchSum geometry, hidden, color;  // the two others take turns
  geometry.take<Real>(samples, s.geometry_cols());
  for (int turn = 0; turn < 2; ++turn) hidden.take<Real>(samples, s.hidden_width);
  if (s.feature_only) return geometry.bytes() + hidden.bytes();
  color.take<Real>(samples, 3);
  for (int turn = 0; turn < 2; ++turn) color.take<Real>(samples, s.color_width);
  if (s.has_direction() && s.direction_once) color.take<Real>(rays, s.color_width);
  if (s.has_direction() && !s.direction_once) color.take<Real>(samples, s.direction_dims);
  return geometry.bytes() + std::max(hidden.bytes(), color.bytes());
}

/// In `saved`, or, when no backward will follow, in the workspace.
template <class Real>
Activations<Real> place(const TinyMlpShape& s, std::int64_t samples, Saved saved, Workspace& arena) {
  std::byte* at = saved.empty() ? arena.take_bytes(saved_bytes<Real>(s, samples)) : saved.data();
  const auto take = [&](std::int32_t cols) {
    const View<Real> view(reinterpret_cast<Real*>(at), samples, cols);
    at += padded(samples, cols, sizeof(Real));
    return view;
  };
  Activations<Real> a;
  for (std::size_t i = 0; i < s.hidden.size(); ++i) a.hidden[i] = take(s.hidden_width);
  a.geometry = take(s.geometry_cols());
  for (std::size_t i = 0; i < s.color.size(); ++i) a.color[i] = take(s.color_width);
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
LinearGrad<Real> gradients(const TinyMlpShape& s, const Tensors<Real>& t, const TinyMlpLayer& layer, View<Real> dx,
                           bool add_to_dx = false) {
  return {value(t, layer.weight_t), grad_of(t, layer.weight), grad_of(t, layer.bias), dx, add_to_dx, s.precision};
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
void color_forward(const TinyMlpShape& s, Workspace& arena, const Tensors<Real>& t, const FieldIn<Real>& in,
                   const Activations<Real>& a, View<Real> rgb) {
  const View<const Real> bias = value(t, s.color[0].bias);
  const View<const Real> weight = value(t, s.color[0].weight).row_range(0, s.geometry_features);
  const View<const Real> direction_weight =
      value(t, s.color[0].weight).row_range(s.geometry_features, s.direction_dims);
  if (!s.has_direction()) {
    linear_forward<Real>(a.features(s), weight, bias, Activation::relu, a.color[0], s.precision);
  } else if (s.direction_once) {
    const View<Real> ray_term = arena.take<Real>(in.direction.rows, s.color_width);
    linear_forward(in.direction, direction_weight, bias, Activation::none, ray_term, s.precision);
    linear_forward_per_ray<Real>(a.features(s), weight, ray_term, in.ray_of_sample, Activation::relu, a.color[0],
                                 s.precision);
  } else {
    linear_forward<Real>(gather_directions(in, arena), direction_weight, bias, Activation::none, a.color[0],
                         s.precision);
    linear_forward_add<Real>(a.features(s), weight, Activation::relu, a.color[0], s.precision);
  }
  for (std::size_t i = 1; i < s.color.size(); ++i) {
    linear_forward<Real>(a.color[i - 1], value(t, s.color[i].weight), value(t, s.color[i].bias), Activation::relu,
                         a.color[i], s.precision);
  }
  linear_forward<Real>(a.color[s.color.size() - 1], value(t, s.rgb.weight), value(t, s.rgb.bias), Activation::none, rgb,
                       s.precision);
  if (rgb.contiguous()) {
    sigmoid_inplace(rgb.data, rgb.size());
  } else {
    for (std::int64_t m = 0; m < rgb.rows; ++m) sigmoid_inplace(rgb.row(m), rgb.cols);
  }
}

template <class Real>
void forward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
             const FieldOut<Real>& out, Saved saved) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  const Workspace::Scope scope(*ctx.workspace);
  const Activations<Real> a = place<Real>(s, in.position.rows, saved, *ctx.workspace);
  const std::size_t last = s.hidden.size() - 1;
  for (std::size_t i = 0; i <= last; ++i) {
    linear_forward<Real>(i == 0 ? in.position : View<const Real>(a.hidden[i - 1]), value(t, s.hidden[i].weight),
                         value(t, s.hidden[i].bias), Activation::relu, a.hidden[i], s.precision);
  }
  SEMFIELD_CHECK(!s.feature_only || (out.sigma.empty() && out.rgb.empty()), "this network has its feature alone");
  const bool wants_features = !out.rgb.empty() || (!out.feature.empty() && s.feature == TinyFeature::geometry);
  // In bf16 a single column would be computed in fp32, and a density query would differ from the others.
  if (wants_features || (s.precision == Precision::bf16 && !out.sigma.empty())) {
    linear_forward<Real>(a.hidden[last], value(t, s.geometry.weight), value(t, s.geometry.bias), Activation::none,
                         a.geometry, s.precision);
    if (!out.sigma.empty()) copy_rows<Real>(a.geometry.col_range(0, 1), out.sigma);
  } else if (!out.sigma.empty()) {
    // A density query: one column of the product, the same chain of sums.
    linear_forward<Real>(a.hidden[last], value(t, s.geometry.weight).col_range(0, 1),
                         value(t, s.geometry.bias).col_range(0, 1), Activation::none, out.sigma, s.precision);
  }
  if (!out.feature.empty()) {
    copy_rows<Real>(s.feature == TinyFeature::hidden ? a.hidden[last] : a.features(s), out.feature);
  }
  if (!out.rgb.empty()) color_forward(s, *ctx.workspace, t, in, a, out.rgb);
}

/// From dL/d(rgb) to parameters and, assigned, to dL/d(geometry features).
template <class Real>
void color_backward(const TinyMlpShape& s, Workspace& arena, const Tensors<Real>& t, const FieldIn<Real>& in,
                    View<const Real> rgb, View<const Real> d_rgb, const Activations<Real>& a, View<Real> d_features) {
  const Workspace::Scope scope(arena);
  const std::int64_t samples = in.position.rows;
  const View<Real> d_logit = arena.take<Real>(samples, 3);
  for (std::int64_t m = 0; m < samples; ++m) {
    for (int c = 0; c < 3; ++c) d_logit(m, c) = d_rgb(m, c) * tiny_mlp_sigmoid_slope(rgb(m, c));
  }
  View<Real> dc = arena.take<Real>(samples, s.color_width), spare = arena.take<Real>(samples, s.color_width);
  linear_backward<Real>(a.color[s.color.size() - 1], d_logit, after_relu(gradients(s, t, s.rgb, dc)));
  for (std::size_t i = s.color.size() - 1; i > 0; --i) {
    linear_backward<Real>(a.color[i - 1], dc, after_relu(gradients(s, t, s.color[i], spare)));
    std::swap(dc, spare);
  }
  LinearGrad<Real> g = gradients(s, t, s.color[0], d_features);
  const View<Real> d_direction_weight = g.d_weight.row_range(s.geometry_features, s.direction_dims);
  g.weight_t = g.weight_t.col_range(0, s.geometry_features);
  g.d_weight = g.d_weight.row_range(0, s.geometry_features);
  if (s.has_direction() && s.direction_once) {
    const View<Real> d_term = arena.take<Real>(in.direction.rows, s.color_width);
    per_ray_backward<Real>(dc, in.ray_of_sample, d_term);
    linear_backward<Real>(in.direction, d_term, {{}, d_direction_weight, g.d_bias, {}, false, s.precision});
    g.d_bias = {};
  } else if (s.has_direction()) {
    linear_backward<Real>(gather_directions(in, arena), dc, {{}, d_direction_weight, {}, {}, false, s.precision});
  }
  linear_backward<Real>(a.features(s), dc, g);
}

/// dL/d[sigma, geometry features] from whatever outputs have a gradient; false when all of it is zero.
template <class Real>
bool geometry_gradient(const TinyMlpShape& s, Workspace& arena, const Tensors<Real>& t, const FieldIn<Real>& in,
                       View<const Real> rgb, const FieldGrad<Real>& grad, const Activations<Real>& a,
                       View<Real> d_out) {
  const bool from_head = !grad.feature.empty() && s.feature == TinyFeature::geometry;
  if (grad.sigma.empty() && grad.rgb.empty() && !from_head) return false;
  const View<Real> d_features = d_out.col_range(1, s.geometry_features);
  if (grad.sigma.empty()) {
    fill(d_out.col_range(0, 1), Real(0));
  } else {
    copy_rows(grad.sigma, d_out.col_range(0, 1));
  }
  if (grad.rgb.empty()) {
    fill(d_features, Real(0));
  } else {
    color_backward<Real>(s, arena, t, in, rgb, grad.rgb, a, d_features);
  }
  for (std::int64_t m = 0; from_head && m < d_features.rows; ++m) {
    for (std::int32_t c = 0; c < d_features.cols; ++c) d_features(m, c) += grad.feature(m, c);
  }
  return true;
}

template <class Real>
void backward(const TinyMlpShape& s, const StepContext& ctx, const Tensors<Real>& t, const FieldIn<Real>& in,
              const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved, View<Real> d_position) {
  SEMFIELD_CHECK(ctx.workspace != nullptr, "a field needs a workspace");
  SEMFIELD_CHECK(grad.rgb.empty() || !out.rgb.empty(), "a colour gradient needs the colour that forward gave");
  Workspace& arena = *ctx.workspace;
  const Workspace::Scope scope(arena);
  const std::int64_t samples = in.position.rows;
  const Activations<Real> a = place<Real>(s, samples, saved, arena);
  const View<Real> d_out = arena.take<Real>(samples, s.geometry_cols());
  const bool from_geometry = geometry_gradient<Real>(s, arena, t, in, out.rgb, grad, a, d_out);
  const bool from_hidden = !grad.feature.empty() && s.feature == TinyFeature::hidden;
  if (!from_geometry && !from_hidden) {
    if (!d_position.empty()) fill(d_position, Real(0));
    return;
  }
  View<Real> dh = arena.take<Real>(samples, s.hidden_width), spare = arena.take<Real>(samples, s.hidden_width);
  if (from_hidden) copy_rows(grad.feature, dh);
  const std::size_t last = s.hidden.size() - 1;
  if (from_geometry) {
    linear_backward<Real>(a.hidden[last], d_out, after_relu(gradients(s, t, s.geometry, dh, from_hidden)));
  } else {
    relu_backward<Real>(a.hidden[last], dh);
  }
  for (std::size_t i = last; i > 0; --i) {
    linear_backward<Real>(a.hidden[i - 1], dh, after_relu(gradients(s, t, s.hidden[i], spare)));
    std::swap(dh, spare);
  }
  linear_backward<Real>(in.position, dh, gradients(s, t, s.hidden[0], d_position));
}

template <class Real>
void derive(const TinyMlpShape& s, const Tensors<Real>& t) {
  const auto transposed = [&](const TinyMlpLayer& layer) {
    if (layer.weight >= 0) transpose(value(t, layer.weight), t.value[static_cast<std::size_t>(layer.weight_t)]);
  };
  for (const TinyMlpLayer& layer : s.hidden) transposed(layer);
  for (const TinyMlpLayer& layer : s.color) transposed(layer);
  transposed(s.geometry);
  transposed(s.rgb);
}

template <class Real>
constexpr TinyMlpKernels<Real> kTable{forward<Real>,     backward<Real>, derive<Real>,
                                      saved_bytes<Real>, nullptr,        scratch_bytes<Real>};

}  // namespace

void tiny_mlp_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<float>);
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<float>, Precision::bf16);
  tables.add(Device::cpu, "field 'tiny_mlp'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
