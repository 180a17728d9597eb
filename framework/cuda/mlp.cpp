// Networks on the device: the walk of plugin/mlp over cuBLASLt's products. Everything is queued on launch().stream.
// In bf16 rows between layers, weights and biases are rounded, and sums are fp32, as on a CPU.
#include <array>
#include <type_traits>

#include "core/check.h"
#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "plugin/kernels.h"
#include "plugin/mlp/walk.h"

namespace semfield::cuda {

namespace {

Epilogue forward_epilogue(bool bias, Activation activation) {
  if (activation == Activation::none) return bias ? Epilogue::bias : Epilogue::none;
  return bias ? Epilogue::bias_relu : Epilogue::relu;
}

// A bias as a product's epilogue reads it.
View<const float> bias_of(const View<const float>& exact, const View<const float>&) { return exact; }
View<const __nv_bfloat16> bias_of(const View<const float>&, const View<const __nv_bfloat16>& rounded) {
  return rounded;
}

View<float> writable(View<const float> rows) {
  return {const_cast<float*>(rows.data), rows.rows, rows.cols, rows.row_stride, rows.device};
}

/// Row: float, or __nv_bfloat16 for rows, weights and biases that are rounded, with sums in fp32.
template <class Row>
struct DeviceLayers {
  using Act = Row;
  using Real = float;
  static constexpr bool kRounds = !std::is_same_v<Act, float>;
  static constexpr bool kColumnsAlone = false;  // a narrower product may add in another order

  /// [in, out] of each part, and its layer's bias [1, out]: the tensors themselves, or copies.
  struct Weights {
    Weights(const MlpGraph& graph, const Tensors<float>& t, Workspace& arena) {
      const auto as_act = [&](View<const float> m) -> View<const Act> {
        if constexpr (kRounds) {
          const View<Act> copy = rows_at(arena.take_bytes(row_bytes(m.rows, m.cols)), m.rows, m.cols);
          convert<float, Act>(m, copy);
          return copy;
        } else {
          return m;
        }
      };
      for (const MlpLayer& layer : graph.layers) {
        const View<const Act> rounded =
            layer.parts.empty() ? View<const Act>() : as_act(t.value[static_cast<std::size_t>(layer.bias)]);
        for (const MlpPart& part : layer.parts) {
          if (part.from.node == kRayInput) continue;
          const auto n = static_cast<std::size_t>(part.number);
          of[n] = as_act(
              t.value[static_cast<std::size_t>(part.weight.weight)].row_range(part.weight.first, part.weight.rows));
          rounded_bias[n] = rounded;
        }
      }
    }
    std::array<View<const Act>, kMostMlpParts> of, rounded_bias;
  };

  /// Rows begin at multiples of 16 bytes, as products want them.
  static std::int32_t stride_of(std::int32_t cols) {
    constexpr auto kVector = static_cast<std::int32_t>(16 / sizeof(Act));
    return kRounds ? (cols + kVector - 1) / kVector * kVector : cols;
  }
  static std::size_t row_bytes(std::int64_t rows, std::int32_t cols) {
    constexpr std::size_t kAlignment = 256;
    const std::size_t bytes = static_cast<std::size_t>(rows) * static_cast<std::size_t>(stride_of(cols)) * sizeof(Act);
    return (bytes + kAlignment - 1) / kAlignment * kAlignment;
  }
  static View<Act> rows_at(std::byte* memory, std::int64_t rows, std::int32_t cols) {
    return View<Act>(reinterpret_cast<Act*>(memory), rows, cols, stride_of(cols), Device::cuda);
  }

  static void product(const Weights& w, const MlpPart& part, const MlpProduct<DeviceLayers>& p, Workspace&) {
    const auto n = static_cast<std::size_t>(part.number);
    const View<const Act> weight = w.of[n].col_range(p.columns.first, p.columns.cols);
    if (p.y.empty()) return product_into(w, n, weight, p, p.exact);
    if (!kRounds || p.start.empty() || p.starts_from_bias || !p.row_of.empty())
      return product_into(w, n, weight, p, p.y);
    // The sums are fp32: they go on where they are, and are rounded at the end.
    const View<float> sums = writable(p.start);
    MlpProduct<DeviceLayers> on = p;
    on.relu = false;
    product_into(w, n, weight, on, sums);
    finish_rows(LayerEnd<float, Act>{sums, {}, {}, p.relu, {}, p.y});
  }

  static void input_gradient(const Weights& w, const MlpPart& part, const MlpInputGradient<DeviceLayers>& p,
                             Workspace&) {
    const View<const Act> weight = w.of[static_cast<std::size_t>(part.number)];
    if (p.y.empty()) return gradient_into(weight, p, p.exact);
    if (!kRounds || p.start.empty()) return gradient_into(weight, p, p.y);
    const View<float> sums = writable(p.start);
    MlpInputGradient<DeviceLayers> on = p;
    on.mask = {};
    gradient_into(weight, on, sums);
    finish_rows(LayerEnd<float, Act>{sums, {}, {}, false, p.mask, p.y});
  }

  static void weight_gradient(View<const Act> x, View<const Act> dz, View<float> d_weight, View<float> d_bias,
                              Workspace& arena) {
    linear_backward(LinearBackward<Act, Act>{.x = x, .dz = dz, .d_weight = d_weight, .d_bias = d_bias}, arena);
  }

  static void ray_product(View<const float> rows, View<const float> weight, View<const float> bias, View<float> term,
                          Workspace&) {
    linear_forward(
        LinearForward<float, float>{.x = rows, .weight = weight, .bias = bias, .y = term, .rounded_bias = bias});
  }
  static void ray_weight_gradient(View<const float> rows, View<const float> d_term, View<float> d_weight,
                                  View<float> d_bias, Workspace& arena) {
    DeviceLayers<float>::weight_gradient(rows, d_term, d_weight, d_bias, arena);
  }
  static void per_ray_sum(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_term) {
    per_ray_backward<Act>(dz, ray_of_sample, d_term);
  }
  static void gather(View<const float> rays, View<const std::int32_t> ray_of_sample, View<float> rows) {
    gather_rows(rays, ray_of_sample, rows);
  }

  static void round(View<const float> from, View<Act> to) { convert<float, Act>(from, to); }
  static void copy(View<const float> from, View<float> to) { convert<float, float>(from, to); }
  static void add(View<const float> from, View<float> to) { add_rows<float, float>(from, to); }
  static void zero(View<float> rows) { fill(rows, 0.0F); }
  template <class T>
  requires(!std::is_same_v<T, Bf16>) static void hand_on(View<T> value, const MlpOut<float>& out) {
    using From = std::remove_const_t<T>;
    if (!out.rows.empty()) convert<From, float>(value, out.rows);
    if constexpr (kRounds) {
      if (!out.rounded.empty()) convert<From, __nv_bfloat16>(value, as_bf16(out.rounded));
    }
  }
  static void hand_on(View<const float> exact, View<Bf16> rounded) {
    convert<float, __nv_bfloat16>(exact, as_bf16(rounded));
  }
  static void take(const MlpGrad<float>& grad, View<float> sums) {
    if (!grad.rows.empty()) return copy(grad.rows, sums);
    const std::int64_t rows = grad.rounded.rows;
    convert<__nv_bfloat16, float>(as_bf16(grad.rounded), sums.row_range(0, rows));
    fill(sums.row_range(rows, sums.rows - rows), 0.0F);
  }

  static void through(LayerActivation activation, View<const Act> value, View<const Act> slope, View<float> sums,
                      View<Act> dz) {
    if (activation == LayerActivation::sine) return times_slope<Act>(slope, sums, dz);
    const bool relu = activation == LayerActivation::relu;
    if constexpr (kRounds) {
      finish_rows(LayerEnd<float, Act>{sums, {}, {}, false, relu ? value : View<const Act>(), dz});
    } else if (relu) {
      cuda::relu_backward<float>(value, dz);
    }
  }
  static void sine(View<float> sums, float frequency, View<Act> value, View<Act> slope) {
    sine_rows<Act>(sums, frequency, value, slope);
  }
  static void sigmoid(View<float> rows) { sigmoid_rows(rows); }
  static void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
    cuda::logit_gradient(value, d_value, d_logit);
  }

 private:
  /// out = start + x W, then the ReLU.
  template <class Out>
  static void product_into(const Weights& w, std::size_t n, View<const Act> weight, const MlpProduct<DeviceLayers>& p,
                           View<Out> out) {
    LinearForward<Act, Out> layer;
    layer.x = p.x;
    layer.weight = weight;
    layer.y = out;
    layer.add = static_cast<const void*>(p.start.data) == out.data;
    if (p.starts_from_bias) {
      layer.bias = p.start;
      if constexpr (std::is_same_v<Out, float>) {
        layer.rounded_bias = p.start;
      } else {
        layer.rounded_bias = w.rounded_bias[n].col_range(p.columns.first, p.columns.cols);
      }
    }
    const bool in_one = p.starts_from_bias || layer.add;
    if (in_one) layer.activation = p.relu ? Activation::relu : Activation::none;
    linear_forward(layer);
    if (!in_one) finish_rows(LayerEnd<Out, Out>{out, p.start, p.row_of, p.relu, {}, out});
  }

  /// out = start + dz W^T, 0 where the mask is not positive.
  template <class Out>
  static void gradient_into(View<const Act> weight, const MlpInputGradient<DeviceLayers>& p, View<Out> out) {
    const bool add = static_cast<const void*>(p.start.data) == out.data;
    cuda::product({.a = Matrix(p.dz), .b = Matrix(weight, true), .d = Matrix(out), .add = add});
    if (!p.start.empty() && !add) {
      if constexpr (std::is_same_v<Out, float>) finish_rows(LayerEnd<float, float>{out, p.start, {}, false, {}, out});
    }
    if (!p.mask.empty()) {
      if constexpr (std::is_same_v<Out, Act>) cuda::relu_backward<Act>(p.mask, out);
    }
  }
};

template <class Act>
using Walk = MlpWalk<DeviceLayers<Act>>;

template <class Act>
void forward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
             MlpOuts<float> out, Saved saved) {
  const Workspace::Scope scope(arena);
  Walk<Act>(graph, tensors, in, out, arena).forward(saved);
}

template <class Act>
void backward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
              MlpOuts<float> out, MlpGrads<float> grad, Saved saved, View<float> d_samples) {
  const Workspace::Scope scope(arena);
  Walk<Act>(graph, tensors, in, out, arena).backward(grad, saved, d_samples);
}

// F V and b_F V + b_V of each fold. Products read a matrix either way: nothing is rearranged.
void derive(const MlpGraph& graph, const Tensors<float>& t) {
  const auto value = [&](int i) { return t.value[static_cast<std::size_t>(i)]; };
  for (const MlpFold& fold : graph.folds) {
    const View<const float> second = value(fold.second_weight).row_range(fold.first, fold.mid);
    small_products(std::array<SmallProduct, 2>{
        SmallProduct{.a = Matrix(value(fold.first_weight)), .b = Matrix(second), .d = value(fold.weight)},
        SmallProduct{.a = Matrix(value(fold.first_bias)),
                     .b = Matrix(second),
                     .c = value(fold.second_bias),
                     .d = value(fold.bias)}});
  }
}

/// dF += dP V^T, dV += F^T dP + b_F^T dp, db_F += dp V^T, db_V += dp.
void derive_backward(const MlpGraph& graph, const Tensors<float>& t) {
  if (t.grad.empty()) return;
  const auto value = [&](int i) { return t.value[static_cast<std::size_t>(i)]; };
  const auto grad_of = [&](int i) { return t.grad[static_cast<std::size_t>(i)]; };
  for (const MlpFold& fold : graph.folds) {
    const View<float> d_product = grad_of(fold.weight), d_bias = grad_of(fold.bias);
    const View<const float> second = value(fold.second_weight).row_range(fold.first, fold.mid);
    small_products(std::array<SmallProduct, 4>{
        SmallProduct{.a = Matrix(d_product), .b = Matrix(second, true), .d = grad_of(fold.first_weight), .add = true},
        SmallProduct{.a = Matrix(value(fold.first_weight), true),
                     .b = Matrix(d_product),
                     .a2 = Matrix(value(fold.first_bias), true),
                     .b2 = Matrix(d_bias),
                     .d = grad_of(fold.second_weight).row_range(fold.first, fold.mid),
                     .add = true},
        SmallProduct{.a = Matrix(d_bias), .b = Matrix(second, true), .d = grad_of(fold.first_bias), .add = true},
        SmallProduct{.c = d_bias, .d = grad_of(fold.second_bias), .add = true}});
  }
}

template <class Act>
constexpr MlpKernels<float> kTable{forward<Act>,    backward<Act>,          derive,
                                   derive_backward, Walk<Act>::saved_bytes, DeviceLayers<Act>::kRounds};

// Heads of one hidden layer on the device. Everything is queued on launch().stream.

constexpr std::int32_t kMostSmallClasses = 128;  // with more, cuBLASLt's kernels are the faster ones

// The same matrix in bf16, in the arena.
View<__nv_bfloat16> rounded(Workspace& arena, View<const float> in) {
  const View<__nv_bfloat16> out = arena.take<__nv_bfloat16>(in.rows, in.cols);
  convert<float, __nv_bfloat16>(in, out);
  return out;
}

template <class Act, class Out>
void layer(View<const Act> x, View<const Act> weight, View<const float> bias, View<Out> y,
           Activation activation = Activation::none) {
  linear_forward(LinearForward<Act, Out>{.x = x, .weight = weight, .bias = bias, .y = y, .activation = activation});
}

SmallProduct times(const Matrix& a, const Matrix& b, View<float> d, bool add) {
  return {.a = a, .b = b, .d = d, .add = add};
}

void head_hidden_forward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors,
                         View<const float> feature, View<float> hidden) {
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight], bias = tensors.value[kHiddenBias];
  if (shape.precision == Precision::bf16) {
    layer<__nv_bfloat16, float>(rounded(arena, feature), rounded(arena, weight), bias, hidden, Activation::relu);
  } else {
    layer<float, float>(feature, weight, bias, hidden, Activation::relu);
  }
}

template <class Act, class Dx>
void layer_backward(Workspace& arena, const Tensors<float>& tensors, View<const Act> x, View<const Act> dz,
                    View<const Act> weight, View<Dx> dx) {
  linear_backward(LinearBackward<Act, Dx>{.x = x,
                                          .dz = dz,
                                          .weight = weight,
                                          .d_weight = tensors.grad[kHiddenWeight],
                                          .d_bias = tensors.grad[kHiddenBias],
                                          .dx = dx},
                  arena);
}

void head_hidden_backward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors,
                          View<const float> feature, View<const float> hidden, View<float> d_hidden,
                          View<float> d_feature) {
  const Workspace::Scope scope(arena);
  const View<const float> weight = tensors.value[kHiddenWeight];
  cuda::relu_backward<float>(hidden, d_hidden);
  if (shape.precision == Precision::bf16) {
    layer_backward<__nv_bfloat16, float>(arena, tensors, rounded(arena, feature), rounded(arena, d_hidden),
                                         rounded(arena, weight), d_feature);
  } else {
    layer_backward<float, float>(arena, tensors, feature, d_hidden, weight, d_feature);
  }
}

void rounded_hidden_forward(const HeadShape&, Workspace& arena, const Tensors<float>& tensors, View<const Bf16> feature,
                            View<Bf16> hidden) {
  const Workspace::Scope scope(arena);
  linear_forward(
      LinearForward<__nv_bfloat16, __nv_bfloat16>{.x = as_bf16(feature),
                                                  .weight = rounded(arena, tensors.value[kHiddenWeight]),
                                                  .bias = tensors.value[kHiddenBias],
                                                  .y = as_bf16(hidden),
                                                  .activation = Activation::relu,
                                                  .rounded_bias = rounded(arena, tensors.value[kHiddenBias])});
}

void rounded_hidden_backward(const HeadShape&, Workspace& arena, const Tensors<float>& tensors,
                             View<const Bf16> feature, View<const Bf16> d_hidden, View<Bf16> d_feature) {
  const Workspace::Scope scope(arena);
  layer_backward<__nv_bfloat16, __nv_bfloat16>(arena, tensors, as_bf16(feature), as_bf16(d_hidden),
                                               rounded(arena, tensors.value[kHiddenWeight]), as_bf16(d_feature));
}

/// d = a b (+ d), a product of the class layer with many classes: TF32 where the head computes in bf16.
void large_product(const HeadShape& shape, const Matrix& a, const Matrix& b, View<float> d, bool add) {
  product({.a = a, .b = b, .d = Matrix(d), .add = add, .tf32 = shape.precision == Precision::bf16});
}

void output_forward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> h,
                    View<const float> share, View<float> logits) {
  const View<const float> weight = tensors.value[kOutputWeight], bias = tensors.value[kOutputBias];
  if (share.empty()) {
    layer<float, float>(h, weight, bias, logits);
    return;
  }
  // The bias enters as share times its row.
  if (shape.width > kMostSmallClasses) {
    shared_bias_forward(share, bias, logits);
    large_product(shape, Matrix(h), Matrix(weight), logits, true);
    return;
  }
  const SmallProduct product{.a = Matrix(h), .b = Matrix(weight), .a2 = Matrix(share), .b2 = Matrix(bias), .d = logits};
  small_products({&product, 1}, &arena);
}

void output_backward(const HeadShape& shape, Workspace& arena, const Tensors<float>& tensors, View<const float> h,
                     View<const float> share, View<const float> d_logits, View<float> d_h, View<float> d_share) {
  const View<const float> weight = tensors.value[kOutputWeight], bias = tensors.value[kOutputBias];
  const View<float> d_weight = tensors.grad[kOutputWeight], d_bias = tensors.grad[kOutputBias];
  if (share.empty()) {
    linear_backward(
        LinearBackward<float, float>{
            .x = h, .dz = d_logits, .weight = weight, .d_weight = d_weight, .d_bias = d_bias, .dx = d_h},
        arena);
    return;
  }
  if (shape.width > kMostSmallClasses) {
    const Workspace::Scope scope(arena);
    if (d_share.empty()) d_share = arena.take<float>(share.rows, 1);
    shared_bias_backward({share, bias, d_logits, d_share, d_bias}, arena);
    large_product(shape, Matrix(d_logits), Matrix(weight, true), d_h, false);
    large_product(shape, Matrix(h, true), Matrix(d_logits), d_weight, true);
    return;
  }
  const std::array<SmallProduct, 4> products = {times(Matrix(d_logits), Matrix(weight, true), d_h, false),
                                                times(Matrix(h, true), Matrix(d_logits), d_weight, true),
                                                times(Matrix(share, true), Matrix(d_logits), d_bias, true),
                                                times(Matrix(d_logits), Matrix(bias, true), d_share, false)};
  small_products(std::span(products).first(d_share.empty() ? 3 : 4), &arena);
}

}  // namespace

template <class Act, class Out>
void linear_forward(const LinearForward<Act, Out>& call) {
  if (call.y.size() == 0) return;
  Product p{.a = Matrix(call.x), .b = Matrix(call.weight), .d = Matrix(call.y), .add = call.add};
  const View<const Out> bias = bias_of(call.bias, call.rounded_bias);
  p.epilogue = forward_epilogue(!call.bias.empty(), call.activation);
  p.bias = bias.data;
  const bool in_one = call.bias.empty() || !bias.empty();
  if (in_one && product(p)) return;
  p.epilogue = Epilogue::none;
  p.bias = nullptr;
  product(p);
  const bool relu = call.activation == Activation::relu;
  if (!call.bias.empty() || relu) finish_rows(LayerEnd<Out, Out>{call.y, call.bias, {}, relu, {}, call.y});
}

template <class Act, class Dx>
void linear_backward(const LinearBackward<Act, Dx>& call, Workspace& arena) {
  if (call.dz.rows == 0) return;
  const Workspace::Scope scope(arena);
  if (!call.d_weight.empty()) {
    product({.a = Matrix(call.x.col_range(0, static_cast<std::int32_t>(call.d_weight.rows)), true),
             .b = Matrix(call.dz.col_range(0, call.d_weight.cols)),
             .d = Matrix(call.d_weight),
             .add = true});
  }
  // An own pass: cuBLASLt's epilogue for the sums is a kernel of its own on Hopper, and takes more than twice as long.
  if (!call.d_bias.empty()) add_column_sums<Act>(call.dz.col_range(0, call.d_bias.cols), call.d_bias, arena);
  if (call.dx.empty()) return;
  product({.a = Matrix(call.dz), .b = Matrix(call.weight, true), .d = Matrix(call.dx), .add = call.add_to_dx});
}

#define SEMFIELD_INSTANTIATE(Act, Out)                                    \
  template void linear_forward<Act, Out>(const LinearForward<Act, Out>&); \
  template void linear_backward<Act, Out>(const LinearBackward<Act, Out>&, Workspace&);
SEMFIELD_INSTANTIATE(float, float)
SEMFIELD_INSTANTIATE(__nv_bfloat16, float)
SEMFIELD_INSTANTIATE(__nv_bfloat16, __nv_bfloat16)
#undef SEMFIELD_INSTANTIATE

void add_mlp_kernels(KernelTables& tables) {
  tables.add(Device::cuda, kMlpOwner, &kTable<float>);
  tables.add(Device::cuda, kMlpOwner, &kTable<__nv_bfloat16>, Precision::bf16);
}

const HeadKernels<float>& head_kernels() {
  static constexpr HeadKernels<float> kernels{
      nullptr,         head_hidden_forward,    head_hidden_backward,   output_forward,
      output_backward, rounded_hidden_forward, rounded_hidden_backward};
  return kernels;
}

void add_head_kernels(KernelTables& tables) { tables.add(Device::cuda, kHeadOwner, &head_kernels()); }

}  // namespace semfield::cuda
