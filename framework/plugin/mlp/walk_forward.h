// Forward of a network: see plugin/mlp/walk.h.
#pragma once

#include "plugin/mlp/walk.h"

namespace semfield {

template <class B, class Arena>
void MlpWalk<B, Arena>::forward(Saved saved) {
  std::array<int, kMostMlpLayers> reads{};
  count_readers(reads);
  x_ = rounded(in_.samples);
  if (!saved.empty()) place(saved);
  for (std::size_t i = 0; i < count(); ++i) {
    if (!needed_[i]) continue;
    if (saved.empty()) take_rows(i);
    forward_layer(i, !saved.empty());
    if (!saved.empty()) continue;
    for (const MlpPart& part : g_.layers[i].parts) {
      if (part.from.node >= kFirstLayer && --reads[index(part.from)] == 0) give(kept(index(part.from)));
    }
    if (reads[i] == 0) give(kept(i));
  }
}

template <class B, class Arena>
void MlpWalk<B, Arena>::count_readers(std::array<int, kMostMlpLayers>& reads) {
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

template <class B, class Arena>
View<const typename B::Act> MlpWalk<B, Arena>::input(const Rows& from) {
  if (from.node == kSampleInput) return x_;
  return g_.layer(from.node).exact ? View<const Act>(at(from).read) : View<const Act>(at(from).value);
}

template <class B, class Arena>
void MlpWalk<B, Arena>::forward_layer(std::size_t i, bool keeps_slope) {
  const MlpLayer& layer = g_.layers[i];
  if (layer.exact) return forward_exact(i);
  const typename Arena::Scope scope(arena_);
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

template <class B, class Arena>
View<typename B::Real> MlpWalk<B, Arena>::sums_in(View<Act> result) {
  if constexpr (B::kRounds) {
    return arena_.template take<Real>(result.rows, result.cols);
  } else {
    return result;
  }
}

template <class B, class Arena>
void MlpWalk<B, Arena>::products(const MlpLayer& layer, View<Real> sums, bool relu, View<Act> y, View<Real> exact,
                                 const Rows& columns) {
  View<const Real> start = tensor(layer.bias).col_range(columns.first, columns.cols);
  View<const std::int32_t> row_of;
  bool from_bias = true;
  for (const MlpPart& part : layer.parts) {
    if (part.from.node != kRayInput) continue;
    const View<const Real> rows = g_.rays_once ? in_.rays : gathered_rays();
    const View<Real> term = arena_.template take<Real>(rows.rows, layer.width);
    B::ray_product(rows, ray_weight(part), start, term, arena_);
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

template <class B, class Arena>
View<const typename B::Real> MlpWalk<B, Arena>::ray_weight(const MlpPart& part) const {
  return tensor(part.weight.weight).row_range(part.weight.first, part.weight.rows);
}

template <class B, class Arena>
View<const typename B::Real> MlpWalk<B, Arena>::gathered_rays() {
  const View<Real> rows = arena_.template take<Real>(samples_, g_.ray_dims);
  B::gather(in_.rays, in_.ray_of_sample, rows);
  return rows;
}

template <class B, class Arena>
int MlpWalk<B, Arena>::direct_output(std::size_t i) const {
  int found = -1, wanted = 0;
  for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
    if (g_.outputs[k].empty() || index(g_.outputs[k]) != i) continue;
    ++wanted;
    if (g_.outputs[k].cols == g_.layers[i].width) found = static_cast<int>(k);
  }
  return wanted == 1 && g_.layers[i].read.empty() && found >= 0 && out_[static_cast<std::size_t>(found)].rounded.empty()
             ? found
             : -1;
}

template <class B, class Arena>
void MlpWalk<B, Arena>::forward_exact(std::size_t i) {
  const MlpLayer& layer = g_.layers[i];
  const typename Arena::Scope scope(arena_);
  if (const int direct = direct_output(i); direct >= 0) {
    const View<Real> rows = out_[static_cast<std::size_t>(direct)].rows;
    products(layer, rows, false, {}, rows, whole(layer));
    if (layer.activation == LayerActivation::sigmoid) B::sigmoid(rows);
    return;
  }
  if (reads_[i] == 0 && forward_columns(i)) return;
  View<Real> exact;
  if constexpr (!B::kRounds) exact = at(i).value;
  if (exact.empty()) exact = arena_.template take<Real>(samples_, layer.width);
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

template <class B, class Arena>
bool MlpWalk<B, Arena>::forward_columns(std::size_t i) {
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

}  // namespace semfield
