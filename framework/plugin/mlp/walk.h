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

#include "plugin/mlp/mlp.h"

namespace semfield {

/// One forward or backward.
template <class B>
class MlpWalk {
  using Act = typename B::Act;
  using Real = typename B::Real;

 public:
  MlpWalk(const MlpGraph& graph, const Tensors<Real>& tensors, const MlpIn<Real>& in, MlpOuts<Real> out,
          Workspace& arena)
      : g_(graph), t_(tensors), in_(in), out_(out), arena_(arena), samples_(in.samples.rows), weights_(g_, t_, arena) {}

  void forward(Saved saved) {
    std::array<int, kMostMlpLayers> reads{};
    count_readers(reads);
    x_ = rounded(in_.samples);
    if (!saved.empty()) place(saved);
    for (std::size_t i = 0; i < count(); ++i) {
      if (!needed_[i]) continue;
      // Without a backward, rows whose readers are done serve again.
      if (saved.empty()) take_rows(i, false, [&](std::int32_t cols) { return take(cols); });
      forward_layer(i, !saved.empty());
      if (!saved.empty()) continue;
      for (const MlpPart& part : g_.layers[i].parts) {
        if (part.from.node >= kFirstLayer && --reads[index(part.from)] == 0) give(kept(index(part.from)));
      }
      if (reads[i] == 0) give(kept(i));
    }
  }

  void backward(MlpGrads<Real> grad, Saved saved, View<Real> d_samples) {
    grad_ = grad;
    d_samples_ = d_samples;
    if (count_contributions()) {
      x_ = rounded(in_.samples);
      place(saved);
      for (std::size_t i = 0; i < count(); ++i) begin_gradient(i);
      for (int next = ready(); next >= 0; next = ready()) backward_layer(static_cast<std::size_t>(next));
    }
    if (!d_samples.empty() && !d_samples_written_) B::zero(d_samples);
  }

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
  template <class T>
  static View<T> part_of(const MlpPart& part, View<T> whole) {
    return whole.row_range(part.weight.first, part.weight.rows);
  }

  // ---- memory

  static std::size_t layer_bytes(const MlpLayer& layer, std::int64_t samples) {
    if (layer.parts.empty()) return 0;
    if (layer.exact && layer.read.empty()) return 0;
    if (layer.exact) return B::row_bytes(samples, B::kRounds ? layer.read.cols : layer.width);
    return B::row_bytes(samples, layer.width) * (layer.activation == LayerActivation::sine ? 2 : 1);
  }

  /// Rows of layer i, from next(columns).
  template <class Next>
  void take_rows(std::size_t i, bool with_slope, const Next& next) {
    const MlpLayer& layer = g_.layers[i];
    if (layer_bytes(layer, 1) == 0) return;
    if (layer.exact && B::kRounds) {
      at(i).read = next(layer.read.cols);
      return;
    }
    at(i).value = next(layer.width);
    if (layer.exact) at(i).read = at(i).value.col_range(layer.read.first, layer.read.cols);
    if (with_slope && layer.activation == LayerActivation::sine) at(i).slope = next(layer.width);
  }

  /// The layers' rows in what forward leaves.
  void place(Saved saved) {
    std::byte* memory = saved.data();
    const auto next = [&](std::int32_t cols) {
      const View<Act> rows = B::rows_at(memory, samples_, cols);
      memory += B::row_bytes(samples_, cols);
      return rows;
    };
    for (std::size_t i = 0; i < count(); ++i) take_rows(i, true, next);
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
  void count_readers(std::array<int, kMostMlpLayers>& reads) {
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (!out_[k].empty()) needed_[index(g_.outputs[k])] = true;
    }
    for (std::size_t i = count(); i-- > 0;) {
      for (const MlpPart& part : g_.layers[i].parts) {
        if (!needed_[i] || part.from.node < kFirstLayer) continue;
        needed_[index(part.from)] = true;
        ++reads[index(part.from)];
      }
    }
    reads_ = reads;
  }

  View<const Act> input(const Rows& from) {
    if (from.node == kSampleInput) return x_;
    return g_.layer(from.node).exact ? View<const Act>(at(from).read) : View<const Act>(at(from).value);
  }

  void forward_layer(std::size_t i, bool keeps_slope) {
    const MlpLayer& layer = g_.layers[i];
    if (layer.exact) return forward_exact(i);
    const Workspace::Scope scope(arena_);
    const View<Act> value = at(i).value;
    const bool is_sine = layer.activation == LayerActivation::sine;
    View<Real> sums;
    if (is_sine || product_count(layer) > 1) sums = sums_in(value);
    if (is_sine) {
      products(layer, sums, false, {}, sums, whole(layer));
      B::sine(sums, static_cast<Real>(layer.frequency), value, keeps_slope ? at(i).slope : View<Act>());
    } else {
      products(layer, sums, layer.activation == LayerActivation::relu, value, {}, whole(layer));
    }
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (!g_.outputs[k].empty() && index(g_.outputs[k]) == i && !out_[k].empty()) B::hand_on(value, out_[k]);
    }
  }

  /// Sums in the memory of the result where it can hold them.
  View<Real> sums_in(View<Act> result) {
    if constexpr (B::kRounds) {
      return arena_.take<Real>(result.rows, result.cols);
    } else {
      return result;
    }
  }

  static Rows whole(const MlpLayer& layer) { return {0, 0, layer.width}; }
  static int product_count(const MlpLayer& layer) {
    int products = 0;
    for (const MlpPart& part : layer.parts) products += part.from.node == kRayInput ? 0 : 1;
    return products;
  }

  /// The layer's sums, of `columns` alone: `y` after the ReLU or as they are, or `exact`.
  void products(const MlpLayer& layer, View<Real> sums, bool relu, View<Act> y, View<Real> exact, const Rows& columns) {
    View<const Real> start = tensor(layer.bias).col_range(columns.first, columns.cols);
    View<const std::int32_t> row_of;
    bool from_bias = true;
    for (const MlpPart& part : layer.parts) {
      if (part.from.node != kRayInput) continue;
      const View<const Real> rows = g_.rays_once ? in_.rays : gathered_rays();
      const View<Real> term = arena_.take<Real>(rows.rows, layer.width);
      B::ray_product(rows, part_of(part, tensor(part.weight.weight)), start, term, arena_);
      start = term;
      from_bias = false;
      if (g_.rays_once) row_of = in_.ray_of_sample;
    }
    int left = product_count(layer);
    for (const MlpPart& part : layer.parts) {
      if (part.from.node == kRayInput) continue;
      const bool last = --left == 0;
      MlpProduct<B> product;
      product.x = input(part.from);
      product.start = start;
      product.starts_from_bias = from_bias;
      product.row_of = row_of;
      product.columns = columns;
      product.relu = last && relu;
      product.y = last ? y : View<Act>();
      product.exact = last ? exact : sums;
      B::product(weights_, part, product, arena_);
      start = sums;
      row_of = {};
      from_bias = false;
    }
  }

  View<const Real> gathered_rays() {
    const View<Real> rows = arena_.take<Real>(samples_, g_.ray_dims);
    B::gather(in_.rays, in_.ray_of_sample, rows);
    return rows;
  }

  /// The wanted output that is exactly this layer's sums, or -1.
  int direct_output(std::size_t i) const {
    int found = -1, wanted = 0;
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (g_.outputs[k].empty() || index(g_.outputs[k]) != i) continue;
      ++wanted;
      if (g_.outputs[k].cols == g_.layers[i].width) found = static_cast<int>(k);
    }
    return wanted == 1 && g_.layers[i].read.empty() && found >= 0 &&
                   out_[static_cast<std::size_t>(found)].rounded.empty()
               ? found
               : -1;
  }

  void forward_exact(std::size_t i) {
    const MlpLayer& layer = g_.layers[i];
    const Workspace::Scope scope(arena_);
    if (const int direct = direct_output(i); direct >= 0) {
      const View<Real> rows = out_[static_cast<std::size_t>(direct)].rows;
      products(layer, rows, false, {}, rows, whole(layer));
      if (layer.activation == LayerActivation::sigmoid) B::sigmoid(rows);
      return;
    }
    if (reads_[i] == 0 && forward_columns(i)) return;
    View<Real> exact;
    if constexpr (!B::kRounds) exact = at(i).value;
    if (exact.empty()) exact = arena_.take<Real>(samples_, layer.width);
    products(layer, exact, false, {}, exact, whole(layer));
    if constexpr (B::kRounds) {
      if (!layer.read.empty()) B::round(exact.col_range(layer.read.first, layer.read.cols), at(i).read);
    }
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      const Rows& from = g_.outputs[k];
      if (from.empty() || index(from) != i || out_[k].empty()) continue;
      const View<const Real> columns = exact.col_range(from.first, from.cols);
      if (!out_[k].rows.empty()) B::copy(columns, out_[k].rows);
      if (!out_[k].rounded.empty()) B::hand_on(columns, out_[k].rounded);
    }
  }

  /// Of a query for some columns no others are computed: the same sums. False where more is wanted.
  bool forward_columns(std::size_t i) {
    if constexpr (!B::kColumnsAlone) return false;
    int only = -1, wanted = 0;
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (g_.outputs[k].empty() || index(g_.outputs[k]) != i || out_[k].empty()) continue;
      only = static_cast<int>(k);
      ++wanted;
    }
    const View<Real> rows = only < 0 ? View<Real>() : out_[static_cast<std::size_t>(only)].rows;
    if (wanted != 1 || rows.empty() || g_.layers[i].parts.size() != 1) return false;
    products(g_.layers[i], rows, false, {}, rows, g_.outputs[static_cast<std::size_t>(only)]);
    return true;
  }

  // ---- backward

  /// Which layers have a gradient and from how many sides it comes. False: nothing has one.
  bool count_contributions() {
    bool any = false;
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (g_.outputs[k].empty() || grad_[k].empty()) continue;
      at(g_.outputs[k]).active = any = true;
      ++at(g_.outputs[k]).missing;
    }
    for (std::size_t i = count(); i-- > 0;) {
      for (const MlpPart& part : g_.layers[i].parts) {
        if (!at(i).active || part.from.node < kFirstLayer) continue;
        State& from = at(part.from);
        from.active = true;
        ++from.missing;
        ++from.awaited;
      }
    }
    return any;
  }

  /// The first layer whose readers have all been visited, or -1.
  int ready() const {
    for (std::size_t i = 0; i < count(); ++i) {
      if (states_[i].active && !states_[i].visited && states_[i].awaited == 0) return static_cast<int>(i);
    }
    return -1;
  }

  /// A hidden layer's gradient begins with that of the output.
  void begin_gradient(std::size_t i) {
    if (g_.layers[i].exact) return;
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      if (g_.outputs[k].empty() || index(g_.outputs[k]) != i || grad_[k].empty()) continue;
      const View<Real> sums = gradient_sums(i);
      B::take(grad_[k], sums);
      at(i).begun = true;
      if (--at(i).missing == 0) finish_gradient(i);
    }
  }

  View<Real> gradient_sums(std::size_t i) {
    State& s = at(i);
    if (s.dz.empty()) s.dz = take(g_.layers[i].width);
    if (s.sums.empty()) s.sums = sums_in(s.dz);
    return s.sums;
  }

  /// From dL/d(activation) in the sums to dz.
  void finish_gradient(std::size_t i) {
    const State& s = at(i);
    B::through(g_.layers[i].activation, s.value, s.slope, s.sums, s.dz);
  }

  /// Adds dz W^T to the gradient of what `part` reads.
  void contribute(const MlpPart& part, View<const Act> dz) {
    if (part.from.node == kSampleInput) {
      if (d_samples_.empty()) return;
      MlpInputGradient<B> call{dz, {}, {}, {}, d_samples_};
      if (d_samples_written_) call.start = d_samples_;
      B::input_gradient(weights_, part, call, arena_);
      d_samples_written_ = true;
      return;
    }
    const std::size_t i = index(part.from);
    const MlpLayer& to = g_.layers[i];
    State& s = at(i);
    --s.missing;
    --s.awaited;
    View<Real> target;
    if (to.exact) {
      if (s.sums.empty()) s.sums = arena_.take<Real>(samples_, to.width);
      target = s.sums.col_range(to.read.first, to.read.cols);
    } else if (s.missing > 0 || to.activation == LayerActivation::sine) {
      target = gradient_sums(i);
    } else if (s.dz.empty()) {
      s.dz = take(to.width);
    }
    MlpInputGradient<B> call{dz, {}, {}, {}, target};
    if (s.begun) call.start = to.exact ? target : s.sums;
    s.begun = true;
    if (target.empty()) {
      if (to.activation == LayerActivation::relu) call.mask = s.value;
      call.y = s.dz;
    }
    B::input_gradient(weights_, part, call, arena_);
    if (!target.empty() && !to.exact && s.missing == 0) finish_gradient(i);
  }

  void backward_layer(std::size_t i) {
    const MlpLayer& layer = g_.layers[i];
    State& s = at(i);
    s.visited = true;
    View<const Act> dz = s.dz;
    View<Act> own;
    if (layer.exact) {
      const View<const Real> sums = exact_gradient(i);
      if constexpr (B::kRounds) {
        own = take(sums.cols);
        B::round(sums, own);
        dz = own;
      } else {
        dz = sums;
      }
    }
    View<Real> d_bias = grad_of(layer.bias);
    int left = product_count(layer);
    for (const MlpPart& part : layer.parts) {
      if (part.from.node == kRayInput) ray_backward(part, dz, d_bias);
    }
    for (const MlpPart& part : layer.parts) {
      if (part.from.node == kRayInput) continue;
      B::weight_gradient(input(part.from), dz, part_of(part, grad_of(part.weight.weight)),
                         --left == 0 ? d_bias : View<Real>(), arena_);
      contribute(part, dz);
    }
    give(layer.exact ? own : s.dz);
  }

  /// Of the rows of the weight that a ray input takes, and, where its term is per ray, of the bias.
  void ray_backward(const MlpPart& part, View<const Act> dz, View<Real>& d_bias) {
    const View<Real> d_weight = part_of(part, grad_of(part.weight.weight));
    if (!g_.rays_once) {
      B::weight_gradient(rounded(gathered_rays()), dz, d_weight, View<Real>(), arena_);
      return;
    }
    const View<Real> d_term = arena_.take<Real>(in_.rays.rows, dz.cols);
    B::per_ray_sum(dz, in_.ray_of_sample, d_term);
    B::ray_weight_gradient(in_.rays, d_term, d_weight, d_bias, arena_);
    d_bias = {};
  }

  /// dL/d(sums) [M, width] of an output layer.
  View<const Real> exact_gradient(std::size_t i) {
    const MlpLayer& layer = g_.layers[i];
    if (const int direct = direct_output(i); direct >= 0 && grad_[static_cast<std::size_t>(direct)].rounded.empty()) {
      const auto k = static_cast<std::size_t>(direct);
      if (layer.activation != LayerActivation::sigmoid) return grad_[k].rows;
      const View<Real> d_logit = arena_.take<Real>(samples_, layer.width);
      B::logit_gradient(View<const Real>(out_[k].rows), grad_[k].rows, d_logit);
      return d_logit;
    }
    State& s = at(i);
    if (s.sums.empty()) s.sums = arena_.take<Real>(samples_, layer.width);
    // What readers have written is added to; all other columns are an output's gradient, or 0.
    const Rows written = s.begun ? layer.read : Rows();
    if (written.first > 0 || written.empty())
      B::zero(s.sums.col_range(0, written.empty() ? layer.width : written.first));
    const std::int32_t end = written.first + written.cols;
    if (!written.empty() && end < layer.width) B::zero(s.sums.col_range(end, layer.width - end));
    for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
      const Rows& from = g_.outputs[k];
      if (from.empty() || index(from) != i || grad_[k].empty()) continue;
      const View<Real> columns = s.sums.col_range(from.first, from.cols);
      View<const Real> of_output = grad_[k].rows;
      if (of_output.empty()) {
        const View<Real> widened = arena_.take<Real>(samples_, from.cols);
        B::take(grad_[k], widened);
        of_output = widened;
      }
      if (from == written) {
        B::add(of_output, columns);
      } else {
        B::copy(of_output, columns);
      }
    }
    return s.sums;
  }

  const MlpGraph& g_;
  const Tensors<Real>& t_;
  const MlpIn<Real>& in_;
  MlpOuts<Real> out_;
  MlpGrads<Real> grad_;
  Workspace& arena_;
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
