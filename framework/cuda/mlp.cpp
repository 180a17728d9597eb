// Networks on the device: the walk of plugin/mlp over cuBLASLt's products. Everything is queued on launch().stream.
// Only fp32 is offered: gradients through sines in bf16 are a third off those in float64.
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

// Rows with the zeros behind them, as products read and write them.
template <class T>
View<T> with_padding(View<T> rows) {
  if constexpr (std::is_same_v<std::remove_const_t<T>, float>) {
    return rows;
  } else {
    return View<T>(rows.data, rows.rows, padded_cols<__nv_bfloat16>(rows.cols), rows.row_stride, Device::cuda);
  }
}

/// A: float, or __nv_bfloat16: activations in memory and operands of products; sums and weights' gradients are
/// fp32, and so is what a ray input adds.
template <class A>
struct DeviceLayers {
  using Act = A;
  using Real = float;
  static constexpr bool kRounds = !std::is_same_v<Act, float>;

  /// [padded in, padded out] of each part, and its layer's bias [1, padded out]: rounded copies in the arena; in fp32
  /// the tensors themselves.
  struct Weights {
    Weights(const MlpGraph& graph, const Tensors<float>& t, Workspace& arena) {
      Roundings roundings;
      for (const MlpLayer& layer : graph.layers) {
        for (const MlpPart& part : layer.parts) {
          if (part.from.node == kRayInput) continue;
          const View<const float> whole = t.value[static_cast<std::size_t>(part.weight.weight)];
          const auto n = static_cast<std::size_t>(part.number);
          of[n] = product_form(whole.row_range(part.weight.first, part.weight.rows), arena, roundings);
          bias[n] = product_form(t.value[static_cast<std::size_t>(layer.bias)], arena, roundings);
        }
      }
      round_matrices(roundings);
    }
    std::array<View<const Act>, kMostMlpParts> of, bias;

   private:
    static View<const Act> product_form(View<const float> m, Workspace& arena, Roundings& roundings) {
      if constexpr (kRounds) {
        const auto rows = static_cast<std::int32_t>(m.rows);
        const std::int32_t padded_rows = rows == 1 ? 1 : padded_cols<Act>(rows), cols = padded_cols<Act>(m.cols);
        const View<Act> copy = arena.take<Act>(padded_rows, cols);
        roundings.all[roundings.count++] = {
            m.data, copy.data, rows, m.cols, static_cast<std::int32_t>(m.row_stride), padded_rows, cols};
        return copy;
      } else {
        return m;
      }
    }
  };
  static_assert(2 * kMostMlpParts <= kMostRoundings);

  static std::size_t row_bytes(std::int64_t rows, std::int32_t cols) {
    constexpr std::size_t kAlignment = 256;
    const std::size_t bytes =
        static_cast<std::size_t>(rows) * static_cast<std::size_t>(padded_cols<Act>(cols)) * sizeof(Act);
    return (bytes + kAlignment - 1) / kAlignment * kAlignment;
  }
  static View<Act> rows_at(std::byte* memory, std::int64_t rows, std::int32_t cols) {
    return View<Act>(reinterpret_cast<Act*>(memory), rows, cols, padded_cols<Act>(cols), Device::cuda);
  }

  static void product(const Weights& w, const MlpPart& part, const MlpProduct<DeviceLayers>& p, Workspace& arena) {
    const auto n = static_cast<std::size_t>(part.number);
    if constexpr (kRounds) {
      LinearForward<Act, Act> to_rows;
      to_rows.x = with_padding(p.x);
      to_rows.weight = w.of[n];
      if (!p.y.empty() && p.starts_from_bias) {
        to_rows.bias = p.start;
        to_rows.rounded_bias = w.bias[n];
        to_rows.activation = p.relu ? Activation::relu : Activation::none;
        to_rows.y = with_padding(p.y);
        linear_forward(to_rows);
        return;
      }
      const Workspace::Scope scope(arena);
      LinearForward<Act, float> to_sums;
      to_sums.x = to_rows.x;
      to_sums.weight = to_rows.weight;
      to_sums.y = arena.take<float>(p.x.rows, to_sums.weight.cols);
      linear_forward(to_sums);
      finish(to_sums.y, p.start, p.row_of, p.relu, {}, p.y, p.exact);
    } else {
      const View<float> out = p.y.empty() ? p.exact : p.y;
      LinearForward<float, float> layer;
      layer.x = p.x;
      layer.weight = w.of[n].col_range(p.columns.first, p.columns.cols);
      layer.y = out;
      layer.add = p.start.data == out.data;
      if (p.starts_from_bias) layer.bias = layer.rounded_bias = p.start;
      const bool in_one = p.starts_from_bias || layer.add;
      if (in_one) layer.activation = p.relu ? Activation::relu : Activation::none;
      linear_forward(layer);
      if (!in_one) finish(out, p.start, p.row_of, p.relu, {}, out, {});
    }
  }

  static void input_gradient(const Weights& w, const MlpPart& part, const MlpInputGradient<DeviceLayers>& p,
                             Workspace& arena) {
    const View<const Act> weight = w.of[static_cast<std::size_t>(part.number)];
    Product call;
    call.a = Matrix(with_padding(p.dz));
    call.b = Matrix(weight, true);
    if constexpr (kRounds) {
      if (!p.y.empty() && p.start.empty()) {
        call.d = Matrix(with_padding(p.y));
        cuda::product(call);
        if (!p.mask.empty()) cuda::relu_backward<Act>(with_padding(p.mask), with_padding(p.y));
        return;
      }
      const Workspace::Scope scope(arena);
      const View<float> sums = arena.take<float>(p.dz.rows, static_cast<std::int32_t>(weight.rows));
      call.d = Matrix(sums);
      cuda::product(call);
      finish(sums, p.start, {}, false, p.mask, p.y, p.exact);
    } else {
      const View<float> out = p.y.empty() ? p.exact : p.y;
      call.d = Matrix(out);
      call.add = p.start.data == out.data;
      cuda::product(call);
      if (!p.start.empty() && !call.add) {
        finish(out, p.start, {}, false, p.mask, out, {});
      } else if (!p.mask.empty()) {
        cuda::relu_backward<float>(p.mask, out);
      }
    }
  }

  static void weight_gradient(View<const Act> x, View<const Act> dz, View<float> d_weight, View<float> d_bias,
                              Workspace& arena) {
    const Workspace::Scope scope(arena);
    LinearBackward<Act, float> call;
    call.x = with_padding(x);
    call.dz = with_padding(dz);
    call.d_bias = d_bias;
    if (d_weight.cols == padded_cols<Act>(d_weight.cols)) {
      call.d_weight = d_weight;
      return linear_backward(call, arena);
    }
    // Too narrow for an aligned product: the columns of zeros are computed too.
    call.d_weight = arena.take<float>(d_weight.rows, call.dz.cols);
    fill(call.d_weight, 0.0F);
    linear_backward(call, arena);
    add_rows<float, float>(call.d_weight.col_range(0, d_weight.cols), d_weight);
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
  static void per_ray_sum(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_term) {
    per_ray_backward<Act>(dz, ray_of_sample, d_term);
  }
  static void gather(View<const float> rays, View<const std::int32_t> ray_of_sample, View<float> rows) {
    gather_rows(rays, ray_of_sample, rows);
  }

  static void round(View<const float> from, View<Act> to) { convert<float, Act>(from, with_padding(to)); }
  static void copy(View<const float> from, View<float> to) { convert<float, float>(from, to); }
  static void add(View<const float> from, View<float> to) { add_rows<float, float>(from, to); }
  static void zero(View<float> rows) { fill(rows, 0.0F); }
  static void hand_on(View<const Act> value, const MlpOut<float>& out) {
    if (!out.rows.empty()) convert<Act, float>(value, out.rows);
    if constexpr (kRounds) {
      if (!out.rounded.empty()) convert<Act, Act>(value, as_bf16(out.rounded));
    }
  }
  static void hand_on(View<const float> exact, View<Bf16> rounded) {
    if constexpr (kRounds) convert<float, Act>(exact, as_bf16(rounded));
  }
  static void take(const MlpGrad<float>& grad, View<float> sums) {
    if (!grad.rows.empty()) return convert<float, float>(grad.rows, sums);
    const std::int64_t rows = grad.rounded.rows;
    convert<__nv_bfloat16, float>(as_bf16(grad.rounded), sums.row_range(0, rows));
    fill(sums.row_range(rows, sums.rows - rows), 0.0F);
  }

  static void through(LayerActivation activation, View<const Act> value, View<const Act> slope, View<float> sums,
                      View<Act> dz) {
    if (activation == LayerActivation::sine) return times_slope<Act>(slope, sums, with_padding(dz));
    const View<const Act> mask = activation == LayerActivation::relu ? value : View<const Act>();
    if constexpr (kRounds) {
      finish(sums, {}, {}, false, mask, dz, {});
    } else if (!mask.empty()) {
      cuda::relu_backward<float>(mask, dz);
    }
  }
  static void sine(View<float> sums, float frequency, View<Act> value, View<Act> slope) {
    sine_rows<Act>(sums, frequency, with_padding(value), slope.empty() ? slope : with_padding(slope));
  }
  static void sigmoid(View<float> rows) { sigmoid_rows(rows); }
  static void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
    cuda::logit_gradient(value, d_value, d_logit);
  }

 private:
  /// sums [M, as y padded] to y or exact.
  static void finish(View<const float> sums, View<const float> start, View<const std::int32_t> row_of, bool relu,
                     View<const Act> mask, View<Act> y, View<float> exact) {
    if (!exact.empty()) {
      finish_rows<Act, float>({sums.col_range(0, exact.cols), start, row_of, relu, mask, exact});
    } else {
      finish_rows<Act, Act>({sums.col_range(0, y.cols), start, row_of, relu, mask, with_padding(y)});
    }
  }
};

template <class Act>
void forward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
             MlpOuts<float> out, Saved saved) {
  const Workspace::Scope scope(arena);
  MlpWalk<DeviceLayers<Act>, Workspace>(graph, tensors, in, out, arena).forward(saved);
}

template <class Act>
void backward(const MlpGraph& graph, Workspace& arena, const Tensors<float>& tensors, const MlpIn<float>& in,
              MlpOuts<float> out, MlpGrads<float> grad, Saved saved, View<float> d_samples) {
  const Workspace::Scope scope(arena);
  MlpWalk<DeviceLayers<Act>, Workspace>(graph, tensors, in, out, arena).backward(grad, saved, d_samples);
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
    forward<Act>, backward<Act>, derive, derive_backward, MlpWalk<DeviceLayers<Act>, Workspace>::saved_bytes, nullptr};

}  // namespace

void add_mlp_kernels(KernelTables& tables) { tables.add(Device::cuda, kMlpOwner, &kTable<float>); }

}  // namespace semfield::cuda
