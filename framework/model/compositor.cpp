// Emission and absorption along rays: scalars of a ray in double, channels of a sample as vectors of Real.
#include "model/compositor.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "compute/math_functions.h"
#include "core/check.h"
#include "core/error.h"
#include "model/stages.h"

namespace semfield {

namespace {

constexpr std::int32_t kAlphaBlock = 64;  // samples whose exponentials are taken together

// alpha = 1 - e^-tau of samples [begin, end), at most kAlphaBlock of them; accurate for tiny tau, where 1 - exp(-tau)
// has no digits left. `rest` is the sample that takes all that is left, or none.
template <class Real>
void block_alphas(const CompositeIn<Real>& in, std::int32_t begin, std::int32_t end, std::int32_t rest, Real* alpha) {
  for (std::int32_t k = begin; k < end; ++k) {
    alpha[k - begin] = static_cast<Real>(-optical_depth(*in.sigma.row(k), *in.samples->delta.row(k)));
    if (k == rest) alpha[k - begin] = -std::numeric_limits<Real>::infinity();
  }
  expm1_inplace(alpha, end - begin);
  for (std::int32_t j = 0; j < end - begin; ++j) alpha[j] = Real(0) - alpha[j];
}

// Transmittance behind each of the samples; tau_sum goes on from block to block.
template <class Real>
void block_transmittances(const CompositeIn<Real>& in, std::int32_t begin, std::int32_t end, std::int32_t rest,
                          double& tau_sum, Real* after) {
  for (std::int32_t k = begin; k < end; ++k) {
    tau_sum += k == rest ? std::numeric_limits<double>::infinity()
                         : optical_depth(*in.sigma.row(k), *in.samples->delta.row(k));
    after[k - begin] = static_cast<Real>(-tau_sum);
  }
  exp_inplace(after, end - begin);
}

// y += a x over n channels.
template <class Real>
void add_scaled(Real a, const Real* __restrict x, Real* __restrict y, std::int32_t n) {
  for (std::int32_t c = 0; c < n; ++c) y[c] += a * x[c];
}

// Sixteen partial sums: the order of additions is fixed by the code, not by the vector width.
template <class Real>
double dot_channels(const Real* __restrict a, const Real* __restrict b, std::int32_t n) {
  constexpr std::int32_t kLanes = 16;
  Real lane[kLanes] = {};
  std::int32_t c = 0;
  for (; c + kLanes <= n; c += kLanes) {
    for (std::int32_t j = 0; j < kLanes; ++j) lane[j] += a[c + j] * b[c + j];
  }
  double sum = 0;
  for (; c < n; ++c) sum += static_cast<double>(a[c]) * static_cast<double>(b[c]);
  for (std::int32_t j = 0; j < kLanes; ++j) sum += static_cast<double>(lane[j]);
  return sum;
}

struct RaySums {
  double color[3] = {0, 0, 0};
  double depth = 0;
  double opacity = 0;
  double tau = 0;
};

template <class Real>
void check_shapes(const CompositeIn<Real>& in, const CompositeOut<Real>& out) {
  SEMFIELD_CHECK(in.samples != nullptr, "compositing needs samples");
  const std::int64_t count = in.samples->count;
  SEMFIELD_CHECK(count == 0 || (in.sigma.rows >= count && out.weight.rows >= count),
                 "density or weight rows are short");
  SEMFIELD_CHECK(in.rgb.empty() || in.rgb.rows >= count, "colour rows are short");
}

template <class Real>
bool hidden_covers(const View<const Real>& hidden, std::int64_t rays, std::int64_t ray) {
  return !hidden.empty() && ray < rays;
}

// Gradients at one ray's outputs.
template <class Real>
struct RayGrad {
  double color[3] = {0, 0, 0};
  double depth = 0;
  double opacity = 0;
  const Real* hidden = nullptr;
  const View<const Real>* weight = nullptr;
  const View<const Real>* dots = nullptr;
  double behind = 0;  // dL/dT_end: what the background colour gives

  RayGrad(const CompositeIn<Real>& in, const CompositeGrad<Real>& grad, std::int64_t r) {
    if (r < grad.color.rows && !grad.color.empty()) {
      for (int c = 0; c < 3; ++c) color[c] = static_cast<double>(grad.color.row(r)[c]);
    }
    if (r < grad.depth.rows && !grad.depth.empty()) depth = static_cast<double>(*grad.depth.row(r));
    if (r < grad.opacity.rows && !grad.opacity.empty()) opacity = static_cast<double>(*grad.opacity.row(r));
    if (!in.hidden.empty() && hidden_covers(grad.hidden, grad.hidden.rows, r)) hidden = grad.hidden.row(r);
    if (!grad.weight.empty()) weight = &grad.weight;
    if (r < grad.dotted_rays) dots = &grad.dots;
    if (in.far != FarMode::closed) {
      for (int c = 0; c < 3; ++c) behind += color[c] * in.background[static_cast<std::size_t>(c)];
    }
  }
};

// d_sigma of one ray. First pass: T_{k+1} into d_sigma. Second, from the back: the recurrence.
template <class Real>
void ray_density_gradient(const CompositeIn<Real>& in, const RayGrad<Real>& grad, bool hidden_counts,
                          std::int32_t begin, std::int32_t end, View<Real> d_sigma) {
  const Samples<Real>& samples = *in.samples;
  Real block[kAlphaBlock];
  double tau_sum = 0;
  for (std::int32_t first = begin; first < end; first += kAlphaBlock) {
    const std::int32_t stop = std::min(end, first + kAlphaBlock);
    block_transmittances(in, first, stop, -1, tau_sum, block);
    for (std::int32_t k = first; k < stop; ++k) *d_sigma.row(k) = block[k - first];
  }
  double behind = grad.behind;  // R_{k+1}
  for (std::int32_t stop = end; stop > begin;) {
    const std::int32_t first = std::max(begin, stop - kAlphaBlock);
    block_alphas(in, first, stop, -1, block);
    for (std::int32_t k = stop; k-- > first;) {
      double value = grad.depth * static_cast<double>(*samples.t.row(k)) + grad.opacity;  // v_k = dL/dw_k
      if (grad.weight != nullptr) value += static_cast<double>(*grad.weight->row(k));
      if (grad.dots != nullptr) value += static_cast<double>(*grad.dots->row(k));
      if (!in.rgb.empty()) {
        const Real* rgb = in.rgb.row(k);
        for (int c = 0; c < 3; ++c) value += grad.color[c] * static_cast<double>(rgb[c]);
      }
      if (hidden_counts && grad.hidden != nullptr) value += dot_channels(grad.hidden, in.hidden.row(k), in.hidden.cols);
      if (in.far == FarMode::background && k + 1 == end) {
        *d_sigma.row(k) = 0;
        behind = value;
        continue;
      }
      const Real delta = *samples.delta.row(k);
      const double after = static_cast<double>(*d_sigma.row(k));
      const double gap = value - behind;
      // Behind an opaque sample nothing is seen; an infinite interval is a switch without a slope.
      const bool has_slope = after != 0 && !std::isinf(delta);
      *d_sigma.row(k) = has_slope ? static_cast<Real>(static_cast<double>(delta) * after * gap) : Real(0);
      behind += static_cast<double>(block[k - first]) * gap;
    }
    stop = first;
  }
}

// Density activations: block by block through the vectorised functions of compute/.

constexpr std::int64_t kDensityBlock = 256;

// f(values, count, first row) for blocks of raw densities, copied: a gradient may be written over its own input.
template <class Real, class F>
void for_blocks(View<const Real> raw, const F& f) {
  Real values[kDensityBlock];
  for (std::int64_t begin = 0; begin < raw.rows; begin += kDensityBlock) {
    const std::int64_t count = std::min(kDensityBlock, raw.rows - begin);
    for (std::int64_t i = 0; i < count; ++i) values[i] = *raw.row(begin + i);
    f(values, count, begin);
  }
}

// The activation's value or, where `slope`, its slope, in place. Written so that NaN stays NaN.
template <class Real>
void activate_inplace(DensityActivation activation, bool slope, Real* x, std::int64_t n) {
  switch (activation) {
    case DensityActivation::relu:
      if (slope) {
        for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] > 0 ? Real(1) : Real(0);
      } else {
        for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] < 0 ? Real(0) : x[i];
      }
      return;
    case DensityActivation::softplus:
      return slope ? sigmoid_inplace(x, n) : softplus_inplace(x, n);
    case DensityActivation::trunc_exp:  // its own slope
      for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] > Real(kTruncExpMax) ? Real(kTruncExpMax) : x[i];
      return exp_inplace(x, n);
  }
}

}  // namespace

template <class Real>
void composite_forward(const CompositeIn<Real>& in, const CompositeOut<Real>& out) {
  check_shapes(in, out);
  const Samples<Real>& samples = *in.samples;
  const bool wants_color = !out.color.empty() && !in.rgb.empty();
  for (std::int64_t r = 0; r + 1 < samples.first.rows; ++r) {
    const std::int32_t begin = *samples.first.row(r), end = *samples.first.row(r + 1);
    Real* hidden = hidden_covers(in.hidden, out.hidden.rows, r) ? out.hidden.row(r) : nullptr;
    if (hidden != nullptr) {
      for (std::int32_t c = 0; c < in.hidden.cols; ++c) hidden[c] = 0;
    }
    RaySums sums;
    Real transmittance = 1;
    const std::int32_t rest = in.far == FarMode::background ? end - 1 : -1;
    for (std::int32_t first = begin; first < end; first += kAlphaBlock) {
      const std::int32_t stop = std::min(end, first + kAlphaBlock);
      Real alpha[kAlphaBlock], after[kAlphaBlock];
      block_alphas(in, first, stop, rest, alpha);
      block_transmittances(in, first, stop, rest, sums.tau, after);
      for (std::int32_t k = first; k < stop; ++k) {
        const Real weight = transmittance * alpha[k - first];
        *out.weight.row(k) = weight;
        transmittance = after[k - first];
        if (weight == Real(0)) continue;
        const double w = static_cast<double>(weight);
        sums.opacity += w;
        sums.depth += w * static_cast<double>(*samples.t.row(k));
        if (wants_color) {
          const Real* rgb = in.rgb.row(k);
          for (int c = 0; c < 3; ++c) sums.color[c] += w * static_cast<double>(rgb[c]);
        }
        if (hidden != nullptr) add_scaled(weight, in.hidden.row(k), hidden, in.hidden.cols);
      }
    }
    if (!out.color.empty()) {
      const double behind = in.far == FarMode::closed ? 0.0 : static_cast<double>(transmittance);
      for (int c = 0; c < 3; ++c) {
        out.color.row(r)[c] = static_cast<Real>(sums.color[c] + behind * in.background[static_cast<std::size_t>(c)]);
      }
    }
    if (!out.depth.empty()) *out.depth.row(r) = static_cast<Real>(sums.depth);
    if (!out.opacity.empty()) *out.opacity.row(r) = static_cast<Real>(sums.opacity);
  }
}

template <class Real>
void composite_backward(const CompositeIn<Real>& in, const CompositeOut<Real>& out, const CompositeGrad<Real>& grad,
                        View<Real> d_sigma, View<Real> d_rgb, View<Real> d_hidden) {
  check_shapes(in, out);
  const Samples<Real>& samples = *in.samples;
  for (std::int64_t r = 0; r + 1 < samples.first.rows; ++r) {
    const std::int32_t begin = *samples.first.row(r), end = *samples.first.row(r + 1);
    const RayGrad<Real> ray(in, grad, r);
    if (!d_sigma.empty()) ray_density_gradient(in, ray, grad.hidden_moves_density, begin, end, d_sigma);
    if (!d_rgb.empty()) {
      for (std::int32_t k = begin; k < end; ++k) {
        const double w = static_cast<double>(*out.weight.row(k));
        for (int c = 0; c < 3; ++c) d_rgb.row(k)[c] = static_cast<Real>(w * ray.color[c]);
      }
    }
    if (d_hidden.empty() || begin >= d_hidden.rows) continue;
    for (std::int32_t k = begin; k < end; ++k) {
      const Real w = *out.weight.row(k);
      Real* row = d_hidden.row(k);
      for (std::int32_t c = 0; c < d_hidden.cols; ++c) row[c] = ray.hidden == nullptr ? Real(0) : w * ray.hidden[c];
    }
  }
}

template <class Real>
void check_density(const Samples<Real>& samples, View<const Real> sigma, std::int64_t first_ray) {
  constexpr Real kLargest = std::numeric_limits<Real>::max();
  int bad = 0;
  if (sigma.contiguous()) {
    for (std::int64_t k = 0; k < samples.count; ++k) bad |= !(sigma.data[k] >= 0) | !(sigma.data[k] <= kLargest);
  } else {
    for (std::int64_t k = 0; k < samples.count; ++k) bad |= !(*sigma.row(k) >= 0) || !(*sigma.row(k) <= kLargest);
  }
  if (bad == 0) return;
  for (std::int64_t r = 0; r + 1 < samples.first.rows; ++r) {
    const std::int32_t begin = *samples.first.row(r), end = *samples.first.row(r + 1);
    for (std::int32_t k = begin; k < end; ++k) {
      const Real value = *sigma.row(k);
      if (value >= 0 && value <= kLargest) continue;
      throw RayFault(first_ray + r, ErrorKind::failure, "train.density.invalid",
                     "density of ray " + std::to_string(first_ray + r) + ", sample " + std::to_string(k - begin) +
                         " at " + std::to_string(static_cast<double>(*samples.t.row(k))) + " m is " +
                         std::to_string(static_cast<double>(value)) + "; it must be finite and not negative",
                     "lower the learning rate, or go back to the last checkpoint");
    }
  }
}

template <class Real>
void add_density_noise(const RandomAddress& address, std::int64_t first_ray, View<const std::int32_t> first,
                       double deviation, View<Real> raw) {
  if (deviation == 0) return;
  for (std::int64_t r = 0; r + 1 < first.rows; ++r) {
    const std::int32_t begin = *first.row(r), end = *first.row(r + 1);
    for (std::int32_t k = begin; k < end; ++k) {
      const auto index = (static_cast<std::uint64_t>(first_ray + r) << 20) + static_cast<std::uint64_t>(k - begin);
      *raw.row(k) += static_cast<Real>(deviation * normal01(address, index));
    }
  }
}

template <class Real>
void density_forward(const DensityRule& rule, const Samples<Real>* samples, View<Real> raw, View<Real> sigma) {
  SEMFIELD_CHECK(raw.rows == sigma.rows, "raw and activated density differ in rows");
  for (std::int64_t m = 0; m < raw.rows && rule.bias != 0; ++m) raw(m, 0) += static_cast<Real>(rule.bias);
  if (rule.deviation > 0) add_density_noise<Real>(rule.random, rule.first_ray, samples->first, rule.deviation, raw);
  const auto per_m = static_cast<Real>(rule.per_m);
  for_blocks<Real>(raw, [&](Real* values, std::int64_t count, std::int64_t begin) {
    activate_inplace(rule.activation, false, values, count);
    for (std::int64_t i = 0; i < count; ++i) *sigma.row(begin + i) = values[i] * per_m;
  });
}

template <class Real>
void density_backward(const DensityRule& rule, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw) {
  SEMFIELD_CHECK(raw.rows == d_sigma.rows && raw.rows == d_raw.rows, "density gradients differ in rows");
  const auto per_m = static_cast<Real>(rule.per_m);
  for_blocks<Real>(raw, [&](Real* values, std::int64_t count, std::int64_t begin) {
    activate_inplace(rule.activation, true, values, count);
    for (std::int64_t i = 0; i < count; ++i) *d_raw.row(begin + i) = *d_sigma.row(begin + i) * values[i] * per_m;
  });
}

template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m) {
  OpacitySums sums;
  sums.at = samples.first(ray, 0);
  const std::int32_t end = samples.first(ray + 1, 0) - (far == FarMode::background ? 1 : 0);
  for (std::int32_t k = sums.at; k < end; ++k) {
    const double w = static_cast<double>(weight(k, 0));
    sums.opacity += w;
    if (w > sums.first) {
      sums.second = sums.first;
      sums.first = w;
      sums.at = k;
    } else if (w > sums.second) {
      sums.second = w;
    }
  }
  if (sums.opacity == 0) return OpacityResolution::clear;  // a ray without samples has no sample `at`
  return resolution_of(sums, static_cast<double>(samples.t(sums.at, 0)), static_cast<double>(samples.delta(sums.at, 0)),
                       footprint_per_m);
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                   \
  template void composite_forward<Real>(const CompositeIn<Real>&, const CompositeOut<Real>&);                        \
  template void composite_backward<Real>(const CompositeIn<Real>&, const CompositeOut<Real>&,                        \
                                         const CompositeGrad<Real>&, View<Real>, View<Real>, View<Real>);            \
  template void check_density<Real>(const Samples<Real>&, View<const Real>, std::int64_t);                           \
  template void density_forward<Real>(const DensityRule&, const Samples<Real>*, View<Real>, View<Real>);             \
  template void density_backward<Real>(const DensityRule&, View<const Real>, View<const Real>, View<Real>);          \
  template void add_density_noise<Real>(const RandomAddress&, std::int64_t, View<const std::int32_t>, double,        \
                                        View<Real>);                                                                 \
  template OpacityResolution opacity_resolution<Real>(const Samples<Real>&, View<const Real>, FarMode, std::int64_t, \
                                                      double);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
