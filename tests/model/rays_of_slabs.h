// Buffers for compositing a few rays, and the same integral in long double.
#pragma once

#include "core/rng.h"
#include "model/compositor.h"

namespace semfield::testing {

/// Addressed uniform numbers for test data.
struct TestNumbers {
  std::uint64_t seed, next = 0;
  double uniform() { return static_cast<double>(uniform01({seed, 0, stream_id("compositor test")}, next++)); }
  double in(double low, double high) { return low + (high - low) * uniform(); }
};

/// Rays of given sample counts with owned buffers; hidden has `channels` columns.
template <class Real>
struct RayBuffers {
  RayBuffers(const std::vector<int>& counts, std::int32_t hidden_channels) : channels(hidden_channels) {
    first.push_back(0);
    for (std::size_t r = 0; r < counts.size(); ++r) {
      for (int k = 0; k < counts[r]; ++k) ray.push_back(static_cast<std::int32_t>(r));
      first.push_back(static_cast<std::int32_t>(ray.size()));
    }
    const std::size_t m = ray.size(), rays = counts.size(), h = static_cast<std::size_t>(channels);
    for (auto* v : {&t, &delta, &sigma, &weight, &d_sigma, &g_weight}) v->assign(m, Real(0));
    for (auto* v : {&rgb, &d_rgb}) v->assign(3 * m, Real(0));
    for (auto* v : {&hidden, &d_hidden}) v->assign(h * m, Real(0));
    for (auto* v : {&color, &g_color}) v->assign(3 * rays, Real(0));
    for (auto* v : {&depth, &opacity, &g_depth, &g_opacity}) v->assign(rays, Real(0));
    for (auto* v : {&out_hidden, &g_hidden}) v->assign(h * rays, Real(0));
    samples = {col(t), col(delta), View<std::int32_t>(ray.data(), rows(), 1),
               View<std::int32_t>(first.data(), static_cast<std::int64_t>(first.size()), 1), rows()};
  }

  std::int64_t rows() const { return static_cast<std::int64_t>(ray.size()); }
  std::int64_t rays() const { return static_cast<std::int64_t>(first.size()) - 1; }
  View<Real> col(std::vector<Real>& v) { return mat(v, 1); }
  View<Real> mat(std::vector<Real>& v, std::int32_t cols) {
    return View<Real>(v.data(), cols == 0 ? 0 : static_cast<std::int64_t>(v.size()) / cols, cols);
  }
  CompositeIn<Real> in() {
    CompositeIn<Real> in{.samples = &samples, .sigma = col(sigma), .rgb = mat(rgb, 3)};
    if (channels > 0) in.hidden = mat(hidden, channels);
    in.far = far;
    in.background = background;
    return in;
  }
  CompositeOut<Real> out() {
    CompositeOut<Real> out{.color = mat(color, 3), .depth = col(depth), .opacity = col(opacity)};
    if (channels > 0) out.hidden = mat(out_hidden, channels);
    out.weight = col(weight);
    return out;
  }
  CompositeGrad<Real> grad() {
    CompositeGrad<Real> grad{
        .color = mat(g_color, 3), .depth = col(g_depth), .opacity = col(g_opacity), .weight = col(g_weight)};
    if (channels > 0) grad.hidden = mat(g_hidden, channels);
    return grad;
  }
  void forward() { composite_forward(in(), out()); }
  void backward() {
    composite_backward(in(), out(), grad(), col(d_sigma), mat(d_rgb, 3),
                       channels > 0 ? mat(d_hidden, channels) : View<Real>());
  }
  /// Samples at k * length / n with equal intervals, for every ray.
  void space_evenly(double length) {
    for (std::int64_t r = 0; r < rays(); ++r) {
      const std::int64_t begin = first[r], n = first[static_cast<std::size_t>(r) + 1] - begin;
      for (std::int64_t k = 0; k < n; ++k) {
        t[begin + k] = static_cast<Real>((static_cast<double>(k) + 0.5) * length / static_cast<double>(n));
        delta[begin + k] = static_cast<Real>(length / static_cast<double>(n));
      }
    }
  }

  /// Densities of 0 to twice `density`, all else in +-1; no gradient of weights.
  void fill_random(std::uint64_t seed, double density) {
    TestNumbers random{seed};
    for (auto& s : sigma) s = static_cast<Real>(random.in(0, 2 * density));
    for (auto* v : {&rgb, &hidden, &g_color, &g_depth, &g_opacity, &g_hidden}) {
      for (auto& x : *v) x = static_cast<Real>(random.in(-1, 1));
    }
  }
  /// The inputs of the last rays of `from`, as many as there are here.
  template <class From>
  void take_inputs(const RayBuffers<From>& from) {
    const auto take = [](const std::vector<From>& all, std::vector<Real>& own) {
      own.assign(all.end() - static_cast<std::ptrdiff_t>(own.size()), all.end());
    };
    take(from.t, t), take(from.delta, delta), take(from.sigma, sigma), take(from.rgb, rgb), take(from.hidden, hidden);
    take(from.g_color, g_color), take(from.g_depth, g_depth), take(from.g_opacity, g_opacity);
    take(from.g_hidden, g_hidden), take(from.g_weight, g_weight);
  }
  /// Sum of gradient times output, of a new forward: what backward differentiates.
  double loss() {
    forward();
    double sum = 0;
    for (const auto& [output, gradient] : {std::pair{&color, &g_color},
                                           {&depth, &g_depth},
                                           {&opacity, &g_opacity},
                                           {&out_hidden, &g_hidden},
                                           {&weight, &g_weight}}) {
      for (std::size_t i = 0; i < output->size(); ++i)
        sum += static_cast<double>((*output)[i]) * static_cast<double>((*gradient)[i]);
    }
    return sum;
  }

  std::int32_t channels;
  std::vector<std::int32_t> first, ray;
  std::vector<Real> t, delta, sigma, weight, d_sigma, rgb, d_rgb, hidden, d_hidden;
  std::vector<Real> color, g_color, depth, g_depth, opacity, g_opacity, out_hidden, g_hidden, g_weight;
  Samples<Real> samples;
  FarMode far = FarMode::open;
  std::array<double, 3> background{};
};

}  // namespace semfield::testing
