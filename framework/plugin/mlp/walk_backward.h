// Backward of a network, and what a forward and a backward take of an arena: see plugin/mlp/walk.h.
#pragma once

#include <vector>

#include "plugin/mlp/walk_forward.h"

namespace semfield {

template <class B, class Arena>
void MlpWalk<B, Arena>::backward(MlpGrads<Real> grad, Saved saved, View<Real> d_samples) {
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

template <class B, class Arena>
bool MlpWalk<B, Arena>::count_contributions() {
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

template <class B, class Arena>
int MlpWalk<B, Arena>::ready() const {
  for (std::size_t i = 0; i < count(); ++i) {
    if (states_[i].active && !states_[i].visited && states_[i].awaited == 0) return static_cast<int>(i);
  }
  return -1;
}

template <class B, class Arena>
void MlpWalk<B, Arena>::begin_gradient(std::size_t i) {
  if (g_.layers[i].exact) return;
  for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
    if (g_.outputs[k].empty() || index(g_.outputs[k]) != i || grad_[k].empty()) continue;
    const View<Real> sums = gradient_sums(i);
    B::take(grad_[k], sums);
    at(i).begun = true;
    if (--at(i).missing == 0) finish_gradient(i);
  }
}

template <class B, class Arena>
View<typename B::Real> MlpWalk<B, Arena>::gradient_sums(std::size_t i) {
  State& s = at(i);
  if (s.dz.empty()) s.dz = take(g_.layers[i].width);
  if (s.sums.empty()) s.sums = sums_in(s.dz);
  return s.sums;
}

template <class B, class Arena>
void MlpWalk<B, Arena>::finish_gradient(std::size_t i) {
  const State& s = at(i);
  B::through(g_.layers[i].activation, s.value, s.slope, s.sums, s.dz);
}

template <class B, class Arena>
void MlpWalk<B, Arena>::contribute(const MlpPart& part, View<const Act> dz) {
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
    if (s.sums.empty()) s.sums = arena_.template take<Real>(samples_, to.width);
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

template <class B, class Arena>
void MlpWalk<B, Arena>::backward_layer(std::size_t i) {
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

template <class B, class Arena>
void MlpWalk<B, Arena>::ray_backward(const MlpPart& part, View<const Act> dz, View<Real>& d_bias) {
  const View<Real> d_weight = part_of(part, grad_of(part.weight.weight));
  if (!g_.rays_once) {
    B::weight_gradient(rounded(gathered_rays()), dz, d_weight, View<Real>(), arena_);
    return;
  }
  const View<Real> d_term = arena_.template take<Real>(in_.rays.rows, dz.cols);
  B::per_ray_sum(dz, in_.ray_of_sample, d_term);
  B::ray_weight_gradient(in_.rays, d_term, d_weight, d_bias, arena_);
  d_bias = {};
}

template <class B, class Arena>
View<const typename B::Real> MlpWalk<B, Arena>::exact_gradient(std::size_t i) {
  const MlpLayer& layer = g_.layers[i];
  if (const int direct = direct_output(i); direct >= 0 && grad_[static_cast<std::size_t>(direct)].rounded.empty()) {
    const auto k = static_cast<std::size_t>(direct);
    if (layer.activation != LayerActivation::sigmoid) return grad_[k].rows;
    const View<Real> d_logit = arena_.template take<Real>(samples_, layer.width);
    B::logit_gradient(View<const Real>(out_[k].rows), grad_[k].rows, d_logit);
    return d_logit;
  }
  State& s = at(i);
  if (s.sums.empty()) s.sums = arena_.template take<Real>(samples_, layer.width);
  // What readers have written is added to; all other columns are an output's gradient, or 0.
  const Rows written = s.begun ? layer.read : Rows();
  if (written.first > 0 || written.empty()) B::zero(s.sums.col_range(0, written.empty() ? layer.width : written.first));
  const std::int32_t end = written.first + written.cols;
  if (!written.empty() && end < layer.width) B::zero(s.sums.col_range(end, layer.width - end));
  for (std::size_t k = 0; k < g_.outputs.size(); ++k) {
    const Rows& from = g_.outputs[k];
    if (from.empty() || index(from) != i || grad_[k].empty()) continue;
    const View<Real> columns = s.sums.col_range(from.first, from.cols);
    View<const Real> of_output = grad_[k].rows;
    if (of_output.empty()) {
      const View<Real> widened = arena_.template take<Real>(samples_, from.cols);
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

/// Most bytes that a forward with `saved` or a backward takes.
template <class B>
std::size_t scratch_of(const MlpGraph& graph, std::int64_t samples, std::int64_t rays) {
  using Real = typename B::Real;
  alignas(64) static std::byte nowhere[64];
  const auto rows = [](std::int64_t count, std::int32_t cols) {
    return View<Real>(reinterpret_cast<Real*>(nowhere), count, cols);
  };
  const std::vector<View<Real>> tensors(1024, rows(0, 0));
  MlpIn<Real> in;
  in.samples = rows(samples, graph.sample_dims);
  if (graph.ray_dims > 0) in.rays = rows(rays, graph.ray_dims);
  std::vector<MlpOut<Real>> out;
  std::vector<MlpGrad<Real>> grad;
  for (const Rows& from : graph.outputs) {
    out.push_back({from.empty() ? View<Real>() : rows(samples, from.cols), {}});
    grad.push_back({out.back().rows, {}});
  }
  CountingArena arena;
  const Tensors<Real> all{tensors, tensors};
  {
    const CountingArena::Scope scope(arena);
    MlpWalk<NoWork<B>, CountingArena>(graph, all, in, out, arena).forward(Saved(nowhere, sizeof nowhere));
  }
  const CountingArena::Scope scope(arena);
  MlpWalk<NoWork<B>, CountingArena>(graph, all, in, out, arena)
      .backward(grad, Saved(nowhere, sizeof nowhere), rows(samples, graph.sample_dims));
  return arena.most();
}

}  // namespace semfield
