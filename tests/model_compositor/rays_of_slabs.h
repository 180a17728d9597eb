// Buffers for compositing a few rays, and the same integral in long double.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "core/rng.h"
#include "model/compositor.h"

namespace semfield::testing {

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
    CompositeIn<Real> in;
    in.samples = &samples;
    in.sigma = col(sigma);
    in.rgb = mat(rgb, 3);
    if (channels > 0) in.hidden = mat(hidden, channels);
    in.far = far;
    in.background = background;
    return in;
  }
  CompositeOut<Real> out() {
    CompositeOut<Real> out;
    out.color = mat(color, 3);
    out.depth = col(depth);
    out.opacity = col(opacity);
    if (channels > 0) out.hidden = mat(out_hidden, channels);
    out.weight = col(weight);
    return out;
  }
  CompositeGrad<Real> grad() {
    CompositeGrad<Real> grad;
    grad.color = mat(g_color, 3);
    grad.depth = col(g_depth);
    grad.opacity = col(g_opacity);
    grad.weight = col(g_weight);
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
      const std::int64_t begin = first[static_cast<std::size_t>(r)], n = first[static_cast<std::size_t>(r) + 1] - begin;
      for (std::int64_t k = 0; k < n; ++k) {
        t[static_cast<std::size_t>(begin + k)] =
            static_cast<Real>((static_cast<double>(k) + 0.5) * length / static_cast<double>(n));
        delta[static_cast<std::size_t>(begin + k)] = static_cast<Real>(length / static_cast<double>(n));
      }
    }
  }

  std::int32_t channels;
  std::vector<std::int32_t> first, ray;
  std::vector<Real> t, delta, sigma, weight, d_sigma, rgb, d_rgb, hidden, d_hidden;
  std::vector<Real> color, g_color, depth, g_depth, opacity, g_opacity, out_hidden, g_hidden, g_weight;
  Samples<Real> samples;
  FarMode far = FarMode::open;
  std::array<double, 3> background{};
};

/// Addressed uniform numbers for test data.
struct TestNumbers {
  std::uint64_t seed, next = 0;
  double uniform() { return static_cast<double>(uniform01({seed, 0, stream_id("compositor test")}, next++)); }
  double in(double low, double high) { return low + (high - low) * uniform(); }
};

}  // namespace semfield::testing
