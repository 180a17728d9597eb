// Networks on the device: the walk of plugin/mlp over cuBLASLt's products. Everything is queued on launch().stream.
// Only fp32 is offered: gradients through sines in bf16 are a third off those in float64.
#include <array>

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

struct DeviceLayers {
  using Act = float;
  using Real = float;
  static constexpr bool kRounds = false;

  /// [in, out] of each part, and its layer's bias [1, out]: the tensors themselves.
  struct Weights {
    Weights(const MlpGraph& graph, const Tensors<float>& t, Workspace&) {
      for (const MlpLayer& layer : graph.layers) {
        for (const MlpPart& part : layer.parts) {
          if (part.from.node == kRayInput) continue;
          const auto n = static_cast<std::size_t>(part.number);
          of[n] = t.value[static_cast<std::size_t>(part.weight.weight)].row_range(part.weight.first, part.weight.rows);
          bias[n] = t.value[static_cast<std::size_t>(layer.bias)];
        }
      }
    }
    std::array<View<const float>, kMostMlpParts> of, bias;
  };

  static std::size_t row_bytes(std::int64_t rows, std::int32_t cols) {
    constexpr std::size_t kAlignment = 256;
    const std::size_t bytes = static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols) * sizeof(float);
    return (bytes + kAlignment - 1) / kAlignment * kAlignment;
  }
  static View<float> rows_at(std::byte* memory, std::int64_t rows, std::int32_t cols) {
    return View<float>(reinterpret_cast<float*>(memory), rows, cols, cols, Device::cuda);
  }

  static void product(const Weights& w, const MlpPart& part, const MlpProduct<DeviceLayers>& p, Workspace&) {
    const View<float> out = p.y.empty() ? p.exact : p.y;
    LinearForward<float, float> layer;
    layer.x = p.x;
    layer.weight = w.of[static_cast<std::size_t>(part.number)].col_range(p.columns.first, p.columns.cols);
    layer.y = out;
    layer.add = p.start.data == out.data;
    if (p.starts_from_bias) layer.bias = layer.rounded_bias = p.start;
    const bool in_one = p.starts_from_bias || layer.add;
    if (in_one) layer.activation = p.relu ? Activation::relu : Activation::none;
    linear_forward(layer);
    if (!in_one) finish_rows({out, p.start, p.row_of, p.relu, {}, out});
  }

  static void input_gradient(const Weights& w, const MlpPart& part, const MlpInputGradient<DeviceLayers>& p,
                             Workspace&) {
    const View<float> out = p.y.empty() ? p.exact : p.y;
    Product call;
    call.a = Matrix(p.dz);
    call.b = Matrix(w.of[static_cast<std::size_t>(part.number)], true);
    call.d = Matrix(out);
    call.add = p.start.data == out.data;
    cuda::product(call);
    if (!p.start.empty() && !call.add) {
      finish_rows({out, p.start, {}, false, p.mask, out});
    } else if (!p.mask.empty()) {
      cuda::relu_backward<float>(p.mask, out);
    }
  }

  static void weight_gradient(View<const float> x, View<const float> dz, View<float> d_weight, View<float> d_bias,
                              Workspace& arena) {
    ray_weight_gradient(x, dz, d_weight, d_bias, arena);
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
    LinearBackward<float, float> call;
    call.x = rows;
    call.dz = d_term;
    call.d_weight = d_weight;
    call.d_bias = d_bias;
    linear_backward(call, arena);
  }
  static void per_ray_sum(View<const float> dz, View<const std::int32_t> ray_of_sample, View<float> d_term) {
    per_ray_backward<float>(dz, ray_of_sample, d_term);
  }
  static void gather(View<const float> rays, View<const std::int32_t> ray_of_sample, View<float> rows) {
    gather_rows(rays, ray_of_sample, rows);
  }

  static void round(View<const float> from, View<float> to) { copy(from, to); }
  static void copy(View<const float> from, View<float> to) { convert<float, float>(from, to); }
  static void add(View<const float> from, View<float> to) { add_rows<float, float>(from, to); }
  static void zero(View<float> rows) { fill(rows, 0.0F); }
  static void hand_on(View<const float> value, const MlpOut<float>& out) {
    if (!out.rows.empty()) copy(value, out.rows);
  }
  static void hand_on(View<const float>, View<Bf16>) {}
  static void take(const MlpGrad<float>& grad, View<float> sums) {
    if (!grad.rows.empty()) return copy(grad.rows, sums);
    const std::int64_t rows = grad.rounded.rows;
    convert<__nv_bfloat16, float>(as_bf16(grad.rounded), sums.row_range(0, rows));
    fill(sums.row_range(rows, sums.rows - rows), 0.0F);
  }

  static void through(LayerActivation activation, View<const float> value, View<const float> slope, View<float> sums,
                      View<float> dz) {
    if (activation == LayerActivation::sine) return times_slope(slope, sums, dz);
    if (activation == LayerActivation::relu) cuda::relu_backward<float>(value, dz);
  }
  static void sine(View<float> sums, float frequency, View<float> value, View<float> slope) {
    sine_rows(sums, frequency, value, slope);
  }
  static void sigmoid(View<float> rows) { sigmoid_rows(rows); }
  static void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
    cuda::logit_gradient(value, d_value, d_logit);
  }
};

void forward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
             MlpOuts<float> out, Saved saved) {
  const Workspace::Scope scope(arena);
  MlpWalk<DeviceLayers, Workspace>(graph, tensors, in, out, arena).forward(saved);
}

void backward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
              MlpOuts<float> out, MlpGrads<float> grad, Saved saved, View<float> d_samples) {
  const Workspace::Scope scope(arena);
  MlpWalk<DeviceLayers, Workspace>(graph, tensors, in, out, arena).backward(grad, saved, d_samples);
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

constexpr MlpKernels<float> kTable{
    forward, backward, derive, derive_backward, MlpWalk<DeviceLayers, Workspace>::saved_bytes, nullptr};

}  // namespace

void add_mlp_kernels(KernelTables& tables) { tables.add(Device::cuda, kMlpOwner, &kTable); }

}  // namespace semfield::cuda
