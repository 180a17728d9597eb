// Networks on the device: the walk of plugin/mlp over cuBLASLt's products. Everything is queued on launch().stream.
// In bf16 rows between layers, weights and biases are rounded, and sums are fp32, as on a CPU.
#include <array>
#include <type_traits>

#include "core/check.h"
#include "cuda/bf16.h"
#include "cuda/kernel_tables.h"
#include "cuda/kernels/layers.h"
#include "cuda/kernels/mlp_rows.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"
#include "plugin/kernels.h"
#include "plugin/mlp/walk_backward.h"

namespace semfield::cuda {

namespace {

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
    LinearBackward<Act, Act> call;
    call.x = x;
    call.dz = dz;
    call.d_weight = d_weight;
    call.d_bias = d_bias;
    linear_backward(call, arena);
  }

  static void ray_product(View<const float> rows, View<const float> weight, View<const float> bias, View<float> term,
                          Workspace&) {
    LinearForward<float, float> call;
    call.x = rows;
    call.weight = weight;
    call.bias = bias;
    call.rounded_bias = bias;
    call.y = term;
    linear_forward(call);
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
    Product call;
    call.a = Matrix(p.dz);
    call.b = Matrix(weight, true);
    call.d = Matrix(out);
    call.add = static_cast<const void*>(p.start.data) == out.data;
    cuda::product(call);
    if (!p.start.empty() && !call.add) {
      if constexpr (std::is_same_v<Out, float>) finish_rows(LayerEnd<float, float>{out, p.start, {}, false, {}, out});
    }
    if (!p.mask.empty()) {
      if constexpr (std::is_same_v<Out, Act>) cuda::relu_backward<Act>(p.mask, out);
    }
  }
};

template <class Act>
using Walk = MlpWalk<DeviceLayers<Act>, Workspace>;

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
    std::array<SmallProduct, 2> products;
    auto& [weight, bias] = products;
    weight.a = Matrix(value(fold.first_weight));
    weight.b = Matrix(second);
    weight.d = value(fold.weight);
    bias.a = Matrix(value(fold.first_bias));
    bias.b = Matrix(second);
    bias.c = value(fold.second_bias);
    bias.d = value(fold.bias);
    small_products(products);
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
    std::array<SmallProduct, 4> products;
    auto& [first_weight, second_weight, first_bias, second_bias] = products;
    first_weight.a = Matrix(d_product);
    first_weight.b = Matrix(second, true);
    first_weight.d = grad_of(fold.first_weight);
    second_weight.a = Matrix(value(fold.first_weight), true);
    second_weight.b = Matrix(d_product);
    second_weight.a2 = Matrix(value(fold.first_bias), true);
    second_weight.b2 = Matrix(d_bias);
    second_weight.d = grad_of(fold.second_weight).row_range(fold.first, fold.mid);
    first_bias.a = Matrix(d_bias);
    first_bias.b = Matrix(second, true);
    first_bias.d = grad_of(fold.first_bias);
    second_bias.c = d_bias;
    second_bias.d = grad_of(fold.second_bias);
    for (SmallProduct& p : products) p.add = true;
    small_products(products);
  }
}

template <class Act>
constexpr MlpKernels<float> kTable{
    forward<Act>, backward<Act>, derive, derive_backward, Walk<Act>::saved_bytes, nullptr, DeviceLayers<Act>::kRounds};

}  // namespace

void add_mlp_kernels(KernelTables& tables) {
  tables.add(Device::cuda, kMlpOwner, &kTable<float>);
  tables.add(Device::cuda, kMlpOwner, &kTable<__nv_bfloat16>, Precision::bf16);
}

}  // namespace semfield::cuda
