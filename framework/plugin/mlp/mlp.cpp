// Builds the graph of a network: which layers are needed, their tensors, and products of linear layers.
#include "plugin/mlp/mlp.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "compute/layers.h"
#include "compute/math_functions.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "plugin/mlp/walk.h"

namespace semfield {

LayerWeight rearranged_weight(std::vector<TensorSpec>& specs, int weight, std::int32_t first, std::int32_t rows,
                              Precision precision) {
  const TensorSpec whole = specs[static_cast<std::size_t>(weight)];
  LayerWeight w;
  w.weight = weight;
  w.first = first;
  w.rows = rows;
  w.cols = whole.cols;
  const std::string part = first > 0 ? "_" + std::to_string(first) : "";
  const auto add = [&](const std::string& name, std::int64_t tensor_rows, std::int32_t cols) {
    specs.push_back({whole.name + name + part, tensor_rows, cols, {}, TensorRole::rearranged});
    return static_cast<int>(specs.size()) - 1;
  };
  if (precision == Precision::bf16) {
    w.forward = add("_packed", packed_weight_words(rows, whole.cols), 1);
    w.backward = add("_t_packed", packed_weight_words(whole.cols, rows), 1);
  } else {
    w.backward = add("_t", whole.cols, rows);
  }
  return w;
}

template <class Real>
Mlp<Real>::Mlp(const MlpBuild& build, const KernelTables& kernels, std::string_view owner)
    : kernels_(&kernels.get<MlpKernels<Real>>(build.device, owner, build.precision)), build_(build) {
  graph_.precision = build.precision;
  graph_.rays_once = build.rays_once;
  graph_.sample_dims = build.sample_dims;
  graph_.ray_dims = build.ray_dims;
}

template <class Real>
Rows Mlp<Real>::layer(const LayerSpec& spec) {
  MlpLayer layer;
  layer.name = spec.name;
  layer.width = spec.width;
  layer.activation = spec.activation;
  layer.frequency = spec.frequency;
  for (const Rows& from : spec.inputs) {
    if (!from.empty()) layer.parts.push_back({from, {}});
  }
  graph_.layers.push_back(layer);
  return {kFirstLayer + static_cast<int>(graph_.layers.size()) - 1, 0, spec.width};
}

template <class Real>
Rows Mlp<Real>::chain(const LayerSpec& spec, int count, int skip_at) {
  Rows last;
  for (int i = 0; i < count; ++i) {
    LayerSpec one = spec;
    one.name += "_" + std::to_string(i);
    if (i > 0 && i != skip_at) one.inputs.clear();
    if (i > 0) one.inputs.push_back(last);
    last = layer(one);
  }
  return last;
}

template <class Real>
void Mlp<Real>::seal() {
  drop_unneeded();
  for (const Rows& out : graph_.outputs) {
    if (out.empty()) continue;
    MlpLayer& layer = graph_.layers[static_cast<std::size_t>(out.node - kFirstLayer)];
    layer.exact = layer.activation == LayerActivation::none || layer.activation == LayerActivation::sigmoid;
    SEMFIELD_CHECK(layer.activation == LayerActivation::none || out.cols == layer.width,
                   "an output is a whole layer, or columns of one without activation");
  }
  declare_layers(graph_.layers);
  if (build_.fold) multiply_linear_pairs();
  for (const MlpLayer& layer : graph_.layers) {
    for (const MlpPart& part : layer.parts) {
      if (part.from.node < kFirstLayer) continue;
      MlpLayer& from = graph_.layers[static_cast<std::size_t>(part.from.node - kFirstLayer)];
      SEMFIELD_CHECK(from.activation != LayerActivation::sigmoid, "no layer reads the sigmoid of an output");
      SEMFIELD_CHECK(from.exact ? from.read.empty() || from.read == part.from : part.from.cols == from.width,
                     "layers read a hidden layer as a whole, and the same columns of an output");
      if (from.exact) from.read = part.from;
    }
  }
  int number = 0;
  for (MlpLayer& layer : graph_.layers) {
    for (MlpPart& part : layer.parts) part.number = number++;
  }
  SEMFIELD_CHECK(number <= kMostMlpParts, "a network has too many layers");
  if (build_.device == Device::cpu) rearrange_weights();
}

template <class Real>
void Mlp<Real>::drop_unneeded() {
  std::vector<MlpLayer>& layers = graph_.layers;
  std::vector<bool> needed(layers.size() + kFirstLayer, false);
  for (const Rows& out : graph_.outputs) {
    if (!out.empty()) needed[static_cast<std::size_t>(out.node)] = true;
  }
  for (std::size_t i = layers.size(); i-- > 0;) {
    for (const MlpPart& part : layers[i].parts) {
      if (needed[i + kFirstLayer]) needed[static_cast<std::size_t>(part.from.node)] = true;
    }
  }
  std::vector<int> number(needed.size(), -1);
  std::vector<MlpLayer> kept;
  number[kSampleInput] = kSampleInput, number[kRayInput] = kRayInput;
  for (std::size_t i = 0; i < layers.size(); ++i) {
    if (!needed[i + kFirstLayer]) continue;
    number[i + kFirstLayer] = kFirstLayer + static_cast<int>(kept.size());
    kept.push_back(layers[i]);
    for (MlpPart& part : kept.back().parts) part.from.node = number[static_cast<std::size_t>(part.from.node)];
  }
  for (Rows& out : graph_.outputs) {
    if (!out.empty()) out.node = number[static_cast<std::size_t>(out.node)];
  }
  layers = std::move(kept);
  SEMFIELD_CHECK(layers.size() <= kMostMlpLayers && graph_.outputs.size() <= kMostMlpOutputs,
                 "a network has too many layers or outputs");
}

template <class Real>
void Mlp<Real>::declare_layers(std::vector<MlpLayer>& layers) {
  const auto tensor = [&](const std::string& name, std::int64_t rows, std::int32_t cols, double bound) {
    specs_.push_back({name, rows, cols, Init::uniform(bound), TensorRole::dense});
    return static_cast<int>(specs_.size()) - 1;
  };
  for (MlpLayer& layer : layers) {
    std::int32_t in = 0;
    bool first = false;
    for (MlpPart& part : layer.parts) {
      part.weight.first = in;
      part.weight.rows = part.from.cols;
      part.weight.cols = layer.width;
      in += part.from.cols;
      first = first || part.from.node == kSampleInput;
    }
    SEMFIELD_CHECK(std::any_of(layer.parts.begin(), layer.parts.end(),
                               [](const MlpPart& part) { return part.from.node != kRayInput; }),
                   "a layer reads at least one row per sample");
    const double of_inputs = 1 / std::sqrt(static_cast<double>(in));
    const double of_sine = first ? 1.0 / in : std::sqrt(6.0 / in) / layer.frequency;
    layer.weight = tensor(layer.name + "/weight", in, layer.width,
                          layer.activation == LayerActivation::sine ? of_sine : of_inputs);
    layer.bias = tensor(layer.name + "/bias", 1, layer.width, of_inputs);
    for (MlpPart& part : layer.parts) part.weight.weight = layer.weight;
  }
}

// A linear layer of one input that one layer alone reads, and that is no output, becomes a factor of that layer.
template <class Real>
void Mlp<Real>::multiply_linear_pairs() {
  for (std::size_t i = 0; i < graph_.layers.size(); ++i) {
    const MlpLayer linear = graph_.layers[i];
    if (linear.activation != LayerActivation::none || linear.exact || linear.parts.size() != 1) continue;
    MlpLayer* reader = nullptr;
    int readers = 0;
    for (MlpLayer& layer : graph_.layers) {
      for (const MlpPart& part : layer.parts) {
        if (part.from.node != kFirstLayer + static_cast<int>(i)) continue;
        ++readers;
        reader = &layer;
      }
    }
    if (readers != 1 || reader->fold >= 0 || reader->parts[0].from.node != kFirstLayer + static_cast<int>(i)) continue;
    MlpPart& part = reader->parts[0];
    MlpFold fold;
    fold.in = linear.parts[0].from.cols, fold.mid = linear.width, fold.out = reader->width;
    fold.first_weight = linear.weight, fold.first_bias = linear.bias;
    fold.second_weight = reader->weight, fold.second_bias = reader->bias;
    fold.second = part.weight;
    const std::string name = "folded" + (graph_.folds.empty() ? "" : "_" + std::to_string(graph_.folds.size()));
    fold.weight = static_cast<int>(specs_.size());
    specs_.push_back({name + "/weight", fold.in, fold.out, {}, TensorRole::derived});
    fold.bias = static_cast<int>(specs_.size());
    specs_.push_back({name + "/bias", 1, fold.out, {}, TensorRole::derived});
    part.from = linear.parts[0].from;
    part.weight = {.weight = fold.weight, .rows = fold.in, .cols = fold.out};
    reader->bias = fold.bias;
    reader->fold = static_cast<int>(graph_.folds.size());
    graph_.folds.push_back(fold);
    graph_.layers[i].parts.clear();  // it is computed no more
  }
}

// What a CPU's kernels read of the weights.
template <class Real>
void Mlp<Real>::rearrange_weights() {
  for (MlpLayer& layer : graph_.layers) {
    for (MlpPart& part : layer.parts) {
      const LayerWeight& w = part.weight;
      if (part.from.node != kRayInput)
        part.weight = rearranged_weight(specs_, w.weight, w.first, w.rows, graph_.precision);
    }
  }
  // In the arithmetic of derive.
  for (MlpFold& fold : graph_.folds)
    fold.second = rearranged_weight(specs_, fold.second_weight, fold.second.first, fold.mid, Precision::fp32);
}

template class Mlp<float>;
template class Mlp<double>;

// Networks on a CPU: the walk over compute/layers.h in fp32, double and bf16.

namespace {

using namespace SEMFIELD_ISA;  // the rearranged weights, of this file

/// Act: float, double or Bf16.
template <class Activation>
struct CpuLayers {
  using Act = Activation;
  using Real = SumOf<Act>;
  static constexpr bool kRounds = std::is_same_v<Act, Bf16>;
  static constexpr bool kColumnsAlone = !kRounds;  // columns of a product have the same bits without the others
  static constexpr std::int32_t kChunk = 256;      // numbers of a row that wait on the stack

  /// The tensors themselves, and what derive made of them.
  struct Weights {
    Weights(const MlpGraph&, const Tensors<Real>& of, Workspace&) : tensors(of) {}
    const Tensors<Real>& tensors;
  };

  static std::size_t row_bytes(std::int64_t rows, std::int32_t cols) { return activation_bytes<Act>(rows, cols); }
  static View<Act> rows_at(std::byte* memory, std::int64_t rows, std::int32_t cols) {
    return activation_rows<Act>(memory, rows, cols);
  }

  static void product(const Weights& w, const MlpPart& part, const MlpProduct<CpuLayers>& p, Workspace&) {
    Layer<Act> layer{.x = p.x,
                     .weight = forward_weight<Act>(part.weight, w.tensors),
                     .start = p.start,
                     .row_of = p.row_of,
                     .relu = p.relu,
                     .y = p.y,
                     .exact = p.exact};
    if constexpr (!kRounds) layer.weight = layer.weight.col_range(p.columns.first, p.columns.cols);
    apply(layer);
  }
  static void input_gradient(const Weights& w, const MlpPart& part, const MlpInputGradient<CpuLayers>& p, Workspace&) {
    apply(Layer<Act>{.x = p.dz,
                     .weight = backward_weight<Act>(part.weight, w.tensors),
                     .start = p.start,
                     .mask = p.mask,
                     .y = p.y,
                     .exact = p.exact});
  }
  static void weight_gradient(View<const Act> x, View<const Act> dz, View<Real> d_weight, View<Real> d_bias,
                              Workspace&) {
    semfield::weight_gradient(x, dz, d_weight, d_bias);
  }
  static void ray_product(View<const Real> rows, View<const Real> weight, View<const Real> bias, View<Real> term,
                          Workspace&) {
    apply(Layer<Real>{.x = rows, .weight = weight, .start = bias, .exact = term});
  }
  static void ray_weight_gradient(View<const Real> rows, View<const Real> d_term, View<Real> d_weight,
                                  View<Real> d_bias, Workspace&) {
    semfield::weight_gradient(rows, d_term, d_weight, d_bias);
  }
  static void per_ray_sum(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<Real> d_term) {
    semfield::per_ray_sum(dz, ray_of_sample, d_term);
  }
  static void gather(View<const Real> rays, View<const std::int32_t> ray_of_sample, View<Real> rows) {
    for (std::int64_t m = 0; m < rows.rows; ++m) std::copy_n(rays.row(ray_of_sample(m, 0)), rows.cols, rows.row(m));
  }

  static void round(View<const Real> from, View<Act> to) {
    if constexpr (kRounds) round_rows(from, to);
  }
  static void copy(View<const Real> from, View<Real> to) { copy_rows<Real>(from, to); }
  static void add(View<const Real> from, View<Real> to) {
    for (std::int64_t m = 0; m < to.rows; ++m) {
      for (std::int32_t i = 0; i < to.cols; ++i) to(m, i) += from(m, i);
    }
  }
  static void zero(View<Real> rows) { fill(rows, Real(0)); }
  static void hand_on(View<const Act> value, const MlpOut<Real>& out) {
    if constexpr (kRounds) {
      if (!out.rows.empty()) widen_rows(value, out.rows);
      for (std::int64_t m = 0; m < out.rounded.rows; ++m) std::copy_n(value.row(m), value.cols, out.rounded.row(m));
    } else if (!out.rows.empty()) {
      copy_rows<Real>(value, out.rows);
    }
  }
  static void hand_on(View<const Real> exact, View<Bf16> rounded) {
    if constexpr (kRounds) round_rows(exact, rounded);
  }
  static void take(const MlpGrad<Real>& grad, View<Real> sums) {
    if (!grad.rows.empty()) return copy_rows<Real>(grad.rows, sums);
    if constexpr (kRounds) {
      const std::int64_t rows = grad.rounded.rows;
      widen_rows(grad.rounded, sums.row_range(0, rows));
      fill(sums.row_range(rows, sums.rows - rows), Real(0));
    }
  }

  /// dz = sums times the slope of the activation that made `value`.
  static void through(LayerActivation activation, View<const Act> value, View<const Act> slope, View<Real> sums,
                      View<Act> dz) {
    if (activation == LayerActivation::sine) return times(slope, sums, dz);
    if constexpr (kRounds) {
      round_rows(sums, dz, activation == LayerActivation::relu ? value : View<const Act>());
    } else {
      if (activation == LayerActivation::relu) relu_backward<Real>(value, dz);
    }
  }
  static void times(View<const Act> slope, View<Real> sums, View<Act> dz) {
    for (std::int64_t m = 0; m < sums.rows; ++m) {
      for (std::int32_t i = 0; i < sums.cols; i += kChunk) {
        const std::int32_t cols = std::min(kChunk, sums.cols - i);
        Real factors[kChunk];
        const View<Real> wide(factors, 1, cols);
        if constexpr (kRounds) {
          widen_rows(slope.row_range(m, 1).col_range(i, cols), wide);
        } else {
          copy_rows<Real>(slope.row_range(m, 1).col_range(i, cols), wide);
        }
        Real* const gradient = sums.row(m) + i;
        for (std::int32_t k = 0; k < cols; ++k) gradient[k] *= factors[k];
      }
    }
    if constexpr (kRounds) round_rows(sums, dz);
  }
  static void sine(View<Real> sums, Real frequency, View<Act> value, View<Act> slope) {
    for (std::int64_t m = 0; m < sums.rows; ++m) {
      for (std::int32_t i = 0; i < sums.cols; i += kChunk) {
        const std::int32_t cols = std::min(kChunk, sums.cols - i);
        Real slopes[kChunk];
        sine_inplace(sums.row(m) + i, cols, frequency, slope.empty() ? nullptr : slopes);
        const View<Act> slope_row = slope.empty() ? slope : slope.row_range(m, 1).col_range(i, cols);
        if constexpr (kRounds) {
          round_rows(sums.row_range(m, 1).col_range(i, cols), value.row_range(m, 1).col_range(i, cols));
          if (!slope.empty()) round_rows(View<Real>(slopes, 1, cols), slope_row);
        } else if (!slope.empty()) {
          copy_rows<Real>(View<Real>(slopes, 1, cols), slope_row);
        }
      }
    }
  }
  static void sigmoid(View<Real> rows) {
    if (rows.contiguous()) return sigmoid_inplace(rows.data, rows.size());
    for (std::int64_t m = 0; m < rows.rows; ++m) sigmoid_inplace(rows.row(m), rows.cols);
  }
  static void logit_gradient(View<const Real> value, View<const Real> d_value, View<Real> d_logit) {
    for (std::int64_t m = 0; m < value.rows; ++m) {
      for (std::int32_t c = 0; c < value.cols; ++c)
        d_logit(m, c) = d_value(m, c) * (value(m, c) * (Real(1) - value(m, c)));
    }
  }
};

template <class Act>
using Walk = MlpWalk<CpuLayers<Act>>;

template <class Act>
void forward(const MlpGraph& graph, Workspace& arena, const Tensors<SumOf<Act>>& tensors, const MlpIn<SumOf<Act>>& in,
             MlpOuts<SumOf<Act>> out, Saved saved) {
  const Workspace::Scope scope(arena);
  Walk<Act>(graph, tensors, in, out, arena).forward(saved);
}

template <class Act>
void backward(const MlpGraph& graph, Workspace& arena, const Tensors<SumOf<Act>>& tensors, const MlpIn<SumOf<Act>>& in,
              MlpOuts<SumOf<Act>> out, MlpGrads<SumOf<Act>> grad, Saved saved, View<SumOf<Act>> d_samples) {
  const Workspace::Scope scope(arena);
  Walk<Act>(graph, tensors, in, out, arena).backward(grad, saved, d_samples);
}

/// V of a fold.
template <class Real>
View<Real> second_part(const MlpFold& fold, std::span<const View<Real>> tensors) {
  return tensors[static_cast<std::size_t>(fold.second_weight)].row_range(fold.first, fold.mid);
}

template <class Act>
void derive(const MlpGraph& graph, const Tensors<SumOf<Act>>& t) {
  using Real = SumOf<Act>;
  const auto tensor = [&](int i) { return t.value[static_cast<std::size_t>(i)]; };
  for (const MlpFold& fold : graph.folds) {
    const View<const Real> second = second_part<Real>(fold, t.value);
    apply(Layer<Real>{.x = tensor(fold.first_weight), .weight = second, .exact = tensor(fold.weight)});
    apply(Layer<Real>{
        .x = tensor(fold.first_bias), .weight = second, .start = tensor(fold.second_bias), .exact = tensor(fold.bias)});
    rearrange<Real>(fold.second, t);
  }
  parallel_for(static_cast<std::int64_t>(graph.layers.size()), [&](std::int64_t i) {
    for (const MlpPart& part : graph.layers[static_cast<std::size_t>(i)].parts) {
      if (part.weight.backward >= 0) rearrange<Act>(part.weight, t);
    }
  });
}

/// dF += dP V^T, dV += F^T dP + b_F^T dp, db_F += dp V^T, db_V += dp.
template <class Real>
void derive_backward(const MlpGraph& graph, const Tensors<Real>& t) {
  if (t.grad.empty()) return;
  const auto grad_of = [&](int i) { return t.grad[static_cast<std::size_t>(i)]; };
  for (const MlpFold& fold : graph.folds) {
    const View<const Real> second_t = backward_weight<Real>(fold.second, t);
    const View<Real> d_second = second_part<Real>(fold, t.grad);
    const auto factor = [&](int i, View<const Real> d_out, View<Real> d_bias) {
      const View<Real> d_factor = grad_of(i);
      weight_gradient(t.value[static_cast<std::size_t>(i)], d_out, d_second, d_bias);
      apply(Layer<Real>{.x = d_out, .weight = second_t, .start = d_factor, .exact = d_factor});
    };
    factor(fold.first_weight, grad_of(fold.weight), {});
    factor(fold.first_bias, grad_of(fold.bias), grad_of(fold.second_bias));
  }
}

template <class Act>
constexpr MlpKernels<SumOf<Act>> kTable{
    forward<Act>,           backward<Act>,           derive<Act>, derive_backward<SumOf<Act>>,
    Walk<Act>::saved_bytes, CpuLayers<Act>::kRounds,
};

}  // namespace

void mlp_kernels(KernelTables& tables) {
  tables.add(Device::cpu, kMlpOwner, &kTable<float>);
  tables.add(Device::cpu, kMlpOwner, &kTable<Bf16>, Precision::bf16);
  tables.add(Device::cpu, kMlpOwner, &kTable<double>);
}

}  // namespace semfield
