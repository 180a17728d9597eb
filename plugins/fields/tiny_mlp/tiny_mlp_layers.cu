// The small network layer by layer on the device.
#include <array>
#include <utility>

#include "core/check.h"
#include "cuda/launch.h"
#include "fields/tiny_mlp/tiny_mlp_layers.cuh"
#include "fields/tiny_mlp/tiny_mlp_products.cuh"

namespace semfield::cuda::tiny {

namespace {

constexpr std::size_t kMaxLayers = 8;

std::size_t padded(std::int64_t rows, std::int32_t cols) {
  constexpr std::size_t kAlign = 256;
  const auto bytes = static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * sizeof(float);
  return (bytes + kAlign - 1) / kAlign * kAlign;
}

/// Activations that backward reads, as on the CPU.
struct Activations {
  std::array<View<float>, kMaxLayers> hidden;  // [M, hidden_width], after ReLU
  View<float> geometry;                        // [M, 1 + G]: sigma and the geometry features
  std::array<View<float>, kMaxLayers> color;   // [M, color_width], after ReLU
};

Activations place(const TinyMlpShape& s, std::int64_t samples, Saved saved, Workspace& arena) {
  std::byte* at = saved.empty() ? arena.take_bytes(layers_saved_bytes(s, samples)) : saved.data();
  const auto take = [&](std::int32_t cols) {
    const View<float> view(reinterpret_cast<float*>(at), samples, cols, cols, Device::cuda);
    at += padded(samples, cols);
    return view;
  };
  Activations a;
  for (std::size_t i = 0; i < s.hidden.size(); ++i) a.hidden[i] = take(s.hidden_width);
  a.geometry = take(s.geometry_cols());
  for (std::size_t i = 0; i < s.color.size(); ++i) a.color[i] = take(s.color_width);
  return a;
}

/// What the calls of one batch share.
class Batch {
 public:
  Batch(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors, const FieldIn<float>& in,
        Saved saved)
      : s_(shape), t_(tensors), in_(in), arena_(*ctx.workspace), a_(place(shape, in.position.rows, saved, arena_)) {}

  void forward(const FieldOut<float>& out);
  void backward(View<const float> rgb, const FieldGrad<float>& grad, View<float> d_position);

 private:
  View<const float> value(int index) const { return t_.value[static_cast<std::size_t>(index)]; }
  View<float> grad_of(int index) const { return t_.grad[static_cast<std::size_t>(index)]; }
  View<float> rows_of(std::int32_t cols) const { return arena_.take<float>(in_.position.rows, cols); }
  View<float> features() const { return a_.geometry.col_range(1, s_.geometry_features); }
  View<const float> direction_weight() const {
    return value(s_.color[0].weight).row_range(s_.geometry_features, s_.direction_dims);
  }
  View<float> gathered_directions() const {
    const View<float> gathered = rows_of(in_.direction.cols);
    gather_rows(in_.direction, in_.ray_of_sample, gathered);
    return gathered;
  }
  void layer(View<const float> x, const TinyMlpLayer& l, Epilogue epilogue, View<float> y, std::int32_t columns) const;
  void gradients(View<const float> x, View<const float> dz, const TinyMlpLayer& l, View<float> dx, bool masked,
                 bool add) const;
  void color_forward(View<float> rgb) const;
  void color_backward(View<const float> rgb, View<const float> d_rgb, View<float> d_features) const;
  bool geometry_gradient(View<const float> rgb, const FieldGrad<float>& grad, View<float> d_out) const;

  const TinyMlpShape& s_;
  const Tensors<float>& t_;
  const FieldIn<float>& in_;
  Workspace& arena_;
  const Activations a_;
  const std::int32_t* live_ = launch().live_rows;
};

/// y [M, columns] = epilogue(x W + b), the first `columns` of the layer's outputs.
void Batch::layer(View<const float> x, const TinyMlpLayer& l, Epilogue epilogue, View<float> y,
                  std::int32_t columns) const {
  Product p;
  p.a = x;
  p.b = value(l.weight).col_range(0, columns);
  p.c = y;
  p.start = value(l.bias);
  p.epilogue = epilogue;
  p.live = live_;
  product(p, s_.precision);
}

/// Of y = x W + b from dz: W, b, and dx = dz W^T; masked: x is the result of a ReLU; add: dx is added to first.
void Batch::gradients(View<const float> x, View<const float> dz, const TinyMlpLayer& l, View<float> dx, bool masked,
                      bool add) const {
  weight_gradient({x, dz, grad_of(l.weight), grad_of(l.bias), live_}, s_.precision, arena_);
  if (dx.empty()) return;
  Product p;
  p.a = dz;
  p.b = value(l.weight);
  p.transposed = true;
  p.c = dx;
  p.add = add;
  if (masked) p.mask = x;
  p.live = live_;
  product(p, s_.precision);
}

void Batch::color_forward(View<float> rgb) const {
  Product p;
  p.a = features();
  p.b = value(s_.color[0].weight).row_range(0, s_.geometry_features);
  p.c = a_.color[0];
  p.start = value(s_.color[0].bias);
  p.epilogue = Epilogue::relu;
  p.live = live_;
  if (s_.has_direction()) {
    Product direction;
    direction.b = direction_weight();
    direction.start = p.start;
    if (s_.direction_once) {
      direction.a = in_.direction;
      direction.c = arena_.take<float>(in_.direction.rows, s_.color_width);
      p.start = direction.c;
      p.ray_of_sample = in_.ray_of_sample;
    } else {
      direction.a = gathered_directions();
      direction.c = p.c;
      direction.live = live_;
      p.add = true;
    }
    product(direction, s_.precision);
  }
  product(p, s_.precision);
  for (std::size_t i = 1; i < s_.color.size(); ++i)
    layer(a_.color[i - 1], s_.color[i], Epilogue::relu, a_.color[i], s_.color_width);
  layer(a_.color[s_.color.size() - 1], s_.rgb, Epilogue::sigmoid, rgb, 3);
}

void Batch::forward(const FieldOut<float>& out) {
  const std::size_t last = s_.hidden.size() - 1;
  for (std::size_t i = 0; i <= last; ++i) {
    layer(i == 0 ? in_.position : View<const float>(a_.hidden[i - 1]), s_.hidden[i], Epilogue::relu, a_.hidden[i],
          s_.hidden_width);
  }
  const bool wants_features = !out.rgb.empty() || (!out.feature.empty() && s_.feature == TinyFeature::geometry);
  if (wants_features) {
    layer(a_.hidden[last], s_.geometry, Epilogue::none, a_.geometry, 1 + s_.geometry_features);
    if (!out.sigma.empty()) copy_rows(a_.geometry.col_range(0, 1), out.sigma, live_);
  } else if (!out.sigma.empty()) {
    layer(a_.hidden[last], s_.geometry, Epilogue::none, out.sigma, 1);  // a density query: one column, the same bits
  }
  if (!out.feature.empty())
    copy_rows(s_.feature == TinyFeature::hidden ? a_.hidden[last] : features(), out.feature, live_);
  if (!out.rgb.empty()) color_forward(out.rgb);
}

/// From dL/d(rgb) to parameters and, assigned, to dL/d(geometry features).
void Batch::color_backward(View<const float> rgb, View<const float> d_rgb, View<float> d_features) const {
  const View<float> d_logit = rows_of(3);
  logit_gradient(rgb, d_rgb, d_logit);
  View<float> dc = rows_of(s_.color_width), spare = rows_of(s_.color_width);
  gradients(a_.color[s_.color.size() - 1], d_logit, s_.rgb, dc, true, false);
  for (std::size_t i = s_.color.size() - 1; i > 0; --i) {
    gradients(a_.color[i - 1], dc, s_.color[i], spare, true, false);
    std::swap(dc, spare);
  }
  const View<float> d_weight = grad_of(s_.color[0].weight);
  const View<float> d_direction_weight = d_weight.row_range(s_.geometry_features, s_.direction_dims);
  View<float> d_bias = grad_of(s_.color[0].bias);
  if (s_.has_direction() && s_.direction_once) {
    const View<float> d_term = arena_.take<float>(in_.direction.rows, s_.color_width);
    sum_per_ray(dc, in_.ray_of_sample, live_, d_term);
    weight_gradient({in_.direction, d_term, d_direction_weight, d_bias, nullptr}, s_.precision, arena_);
    d_bias = {};
  } else if (s_.has_direction()) {
    weight_gradient({gathered_directions(), dc, d_direction_weight, {}, live_}, s_.precision, arena_);
  }
  weight_gradient({features(), dc, d_weight.row_range(0, s_.geometry_features), d_bias, live_}, s_.precision, arena_);
  Product p;
  p.a = dc;
  p.b = value(s_.color[0].weight).row_range(0, s_.geometry_features);
  p.transposed = true;
  p.c = d_features;
  p.live = live_;
  product(p, s_.precision);
}

/// dL/d[sigma, geometry features] from whatever outputs have a gradient; false when all of it is zero.
bool Batch::geometry_gradient(View<const float> rgb, const FieldGrad<float>& grad, View<float> d_out) const {
  const bool from_head = !grad.feature.empty() && s_.feature == TinyFeature::geometry;
  if (grad.sigma.empty() && grad.rgb.empty() && !from_head) return false;
  const View<float> d_features = d_out.col_range(1, s_.geometry_features);
  copy_rows(grad.sigma, d_out.col_range(0, 1), live_);
  if (grad.rgb.empty()) {
    copy_rows({}, d_features, live_);
  } else {
    color_backward(rgb, grad.rgb, d_features);
  }
  if (from_head) copy_rows(grad.feature, d_features, live_, true);
  return true;
}

void Batch::backward(View<const float> rgb, const FieldGrad<float>& grad, View<float> d_position) {
  const View<float> d_out = rows_of(s_.geometry_cols());
  const bool from_geometry = geometry_gradient(rgb, grad, d_out);
  const bool from_hidden = !grad.feature.empty() && s_.feature == TinyFeature::hidden;
  if (!from_geometry && !from_hidden) {
    if (!d_position.empty()) copy_rows({}, d_position, live_);
    return;
  }
  const std::size_t last = s_.hidden.size() - 1;
  View<float> dh = rows_of(s_.hidden_width), spare = rows_of(s_.hidden_width);
  if (from_hidden) copy_rows(grad.feature, dh, live_);
  if (from_geometry) {
    gradients(a_.hidden[last], d_out, s_.geometry, dh, true, from_hidden);
  } else {
    mask_rows(a_.hidden[last], dh);
  }
  for (std::size_t i = last; i > 0; --i) {
    gradients(a_.hidden[i - 1], dh, s_.hidden[i], spare, true, false);
    std::swap(dh, spare);
  }
  gradients(in_.position, dh, s_.hidden[0], d_position, false, false);
}

}  // namespace

std::size_t layers_saved_bytes(const TinyMlpShape& s, std::int64_t samples) {
  return s.hidden.size() * padded(samples, s.hidden_width) + padded(samples, s.geometry_cols()) +
         s.color.size() * padded(samples, s.color_width);
}

void layers_forward(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                    const FieldIn<float>& in, const FieldOut<float>& out, Saved saved) {
  const Workspace::Scope scope(*ctx.workspace);
  Batch(shape, ctx, tensors, in, saved).forward(out);
}

void layers_backward(const TinyMlpShape& shape, const StepContext& ctx, const Tensors<float>& tensors,
                     const FieldIn<float>& in, const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                     View<float> d_position) {
  const Workspace::Scope scope(*ctx.workspace);
  Batch(shape, ctx, tensors, in, saved).backward(out.rgb, grad, d_position);
}

}  // namespace semfield::cuda::tiny
