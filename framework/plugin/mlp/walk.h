// The walk of forward and backward through the layers of a network, one for every device and precision: a backend B
// says what rows are and runs the products. Private to the files that make the kernel tables.
//
// A layer's sums start from its bias (with a ray input from that input's term, which holds the bias) and go on input by
// input; the last product finishes the layer. Backward visits a layer once all its readers have been; of those that are
// ready the first comes first. The gradient of a hidden layer begins with that of the output, and its last reader takes
// it through the activation.
#pragma once

#include <array>
#include <cstddef>

#include "plugin/mlp/backend.h"

namespace semfield {

/// One forward or backward.
template <class B, class Arena>
class MlpWalk {
  using Act = typename B::Act;
  using Real = typename B::Real;

 public:
  MlpWalk(const MlpGraph& graph, const Tensors<Real>& tensors, const MlpIn<Real>& in, MlpOuts<Real> out, Arena& arena)
      : g_(graph), t_(tensors), in_(in), out_(out), arena_(arena), samples_(in.samples.rows), weights_(g_, t_, arena) {}

  void forward(Saved saved);

  void backward(MlpGrads<Real> grad, Saved saved, View<Real> d_samples);

  static std::size_t saved_bytes(const MlpGraph& graph, std::int64_t samples) {
    std::size_t sum = 0;
    for (const MlpLayer& layer : graph.layers) sum += layer_bytes(layer, samples);
    return sum;
  }

 private:
  struct State {
    View<Act> value;  // [M, width] of a hidden layer; in B::Real also of an exact one that is kept
    View<Act> slope;  // [M, width] of a sine
    View<Act> read;   // [M, read.cols] of an exact layer, as others read it
    View<Real> sums;  // backward: [M, width], the gradient so far
    View<Act> dz;     // backward: the gradient before the activation
    int awaited = 0;  // readers that have not been visited
    int missing = 0;  // contributions that are still to come
    bool begun = false, active = false, visited = false;
  };

  std::size_t count() const { return g_.layers.size(); }
  static std::size_t index(const Rows& rows) { return static_cast<std::size_t>(rows.node - kFirstLayer); }
  State& at(std::size_t layer) { return states_[layer]; }
  State& at(const Rows& rows) { return states_[index(rows)]; }
  View<const Real> tensor(int i) const { return t_.value[static_cast<std::size_t>(i)]; }
  View<Real> grad_of(int i) const { return t_.grad[static_cast<std::size_t>(i)]; }
  static View<Real> part_of(const MlpPart& part, View<Real> whole) {
    return whole.row_range(part.weight.first, part.weight.rows);
  }

  // ---- memory

  static std::size_t layer_bytes(const MlpLayer& layer, std::int64_t samples) {
    if (layer.parts.empty()) return 0;
    if (layer.exact && layer.read.empty()) return 0;
    if (layer.exact) return B::row_bytes(samples, B::kRounds ? layer.read.cols : layer.width);
    return B::row_bytes(samples, layer.width) * (layer.activation == LayerActivation::sine ? 2 : 1);
  }

  /// The layers' rows in what forward leaves.
  void place(Saved saved) {
    std::byte* memory = saved.data();
    const auto next = [&](std::int32_t cols) {
      const View<Act> rows = B::rows_at(memory, samples_, cols);
      memory += B::row_bytes(samples_, cols);
      return rows;
    };
    for (std::size_t i = 0; i < count(); ++i) {
      const MlpLayer& layer = g_.layers[i];
      if (layer_bytes(layer, 1) == 0) continue;
      if (layer.exact && B::kRounds) {
        at(i).read = next(layer.read.cols);
        continue;
      }
      at(i).value = next(layer.width);
      if (layer.exact) at(i).read = at(i).value.col_range(layer.read.first, layer.read.cols);
      if (layer.activation == LayerActivation::sine) at(i).slope = next(layer.width);
    }
  }

  /// The same without a backward: rows whose readers are done serve again.
  void take_rows(std::size_t i) {
    const MlpLayer& layer = g_.layers[i];
    if (layer_bytes(layer, 1) == 0) return;
    if (layer.exact && B::kRounds) {
      at(i).read = take(layer.read.cols);
      return;
    }
    at(i).value = take(layer.width);
    if (layer.exact) at(i).read = at(i).value.col_range(layer.read.first, layer.read.cols);
  }

  View<Act> kept(std::size_t i) const { return B::kRounds && g_.layers[i].exact ? states_[i].read : states_[i].value; }

  View<Act> take(std::int32_t cols) {
    for (std::size_t s = 0; s < spare_count_; ++s) {
      if (spare_[s].cols != cols) continue;
      const View<Act> found = spare_[s];
      spare_[s] = spare_[--spare_count_];
      return found;
    }
    return B::rows_at(arena_.take_bytes(B::row_bytes(samples_, cols)), samples_, cols);
  }
  void give(View<Act> rows) {
    if (!rows.empty() && spare_count_ < spare_.size()) spare_[spare_count_++] = rows;
  }

  View<const Act> rounded(View<const Real> values) {
    if constexpr (B::kRounds) {
      const View<Act> rows = take(values.cols);
      B::round(values, rows);
      return rows;
    } else {
      return values;
    }
  }

  // ---- forward

  /// Which layers the wanted outputs need, and how often each is read.
  void count_readers(std::array<int, kMostMlpLayers>& reads);

  View<const Act> input(const Rows& from);

  void forward_layer(std::size_t i, bool keeps_slope);

  /// Sums in the memory of the result where it can hold them.
  View<Real> sums_in(View<Act> result);

  static Rows whole(const MlpLayer& layer) { return {0, 0, layer.width}; }
  static int product_count(const MlpLayer& layer) {
    int products = 0;
    for (const MlpPart& part : layer.parts) products += part.from.node == kRayInput ? 0 : 1;
    return products;
  }

  /// The layer's sums, of `columns` alone: `y` after the ReLU or as they are, or `exact`.
  void products(const MlpLayer& layer, View<Real> sums, bool relu, View<Act> y, View<Real> exact, const Rows& columns);

  View<const Real> ray_weight(const MlpPart& part) const;
  View<const Real> gathered_rays();

  /// The wanted output that is exactly this layer's sums, or -1.
  int direct_output(std::size_t i) const;

  void forward_exact(std::size_t i);

  /// Of a query for some columns no others are computed: the same sums. False where more is wanted.
  bool forward_columns(std::size_t i);

  // ---- backward

  /// Which layers have a gradient and from how many sides it comes. False: nothing has one.
  bool count_contributions();

  /// The first layer whose readers have all been visited, or -1.
  int ready() const;

  /// A hidden layer's gradient begins with that of the output.
  void begin_gradient(std::size_t i);

  View<Real> gradient_sums(std::size_t i);

  /// From dL/d(activation) in the sums to dz.
  void finish_gradient(std::size_t i);

  /// Adds dz W^T to the gradient of what `part` reads.
  void contribute(const MlpPart& part, View<const Act> dz);

  void backward_layer(std::size_t i);

  /// Of the rows of the weight that a ray input takes, and, where its term is per ray, of the bias.
  void ray_backward(const MlpPart& part, View<const Act> dz, View<Real>& d_bias);

  /// dL/d(sums) [M, width] of an output layer.
  View<const Real> exact_gradient(std::size_t i);

  const MlpGraph& g_;
  const Tensors<Real>& t_;
  const MlpIn<Real>& in_;
  MlpOuts<Real> out_;
  MlpGrads<Real> grad_;
  Arena& arena_;
  std::int64_t samples_;
  typename B::Weights weights_;
  View<const Act> x_;
  View<Real> d_samples_;
  bool d_samples_written_ = false;
  std::array<bool, kMostMlpLayers> needed_{};
  std::array<int, kMostMlpLayers> reads_{};
  std::array<State, kMostMlpLayers> states_{};
  std::array<View<Act>, kMostMlpLayers> spare_{};
  std::size_t spare_count_ = 0;
};

}  // namespace semfield
