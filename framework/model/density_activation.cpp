// Density activations: block by block through the vectorised functions of core.
#include "model/density_activation.h"

#include <algorithm>
#include <cmath>

#include "compute/math_functions.h"
#include "core/check.h"

namespace semfield {
namespace {

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

// The activation's value or slope, in place. Written so that NaN stays NaN.
template <class Real>
void truncated_exp(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] > Real(kTruncExpMax) ? Real(kTruncExpMax) : x[i];
  exp_inplace(x, n);
}
template <class Real>
void value_inplace(DensityActivation activation, Real* x, std::int64_t n) {
  switch (activation) {
    case DensityActivation::relu:
      for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] < 0 ? Real(0) : x[i];
      return;
    case DensityActivation::softplus:
      return softplus_inplace(x, n);
    case DensityActivation::trunc_exp:
      return truncated_exp(x, n);
  }
}
template <class Real>
void slope_inplace(DensityActivation activation, Real* x, std::int64_t n) {
  switch (activation) {
    case DensityActivation::relu:
      for (std::int64_t i = 0; i < n; ++i) x[i] = x[i] > 0 ? Real(1) : Real(0);
      return;
    case DensityActivation::softplus:
      return sigmoid_inplace(x, n);
    case DensityActivation::trunc_exp:
      return truncated_exp(x, n);
  }
}

// sigma = per_m * f(raw).
template <class Real>
void activate(DensityActivation activation, Real per_m, View<const Real> raw, View<Real> sigma) {
  SEMFIELD_CHECK(raw.rows == sigma.rows, "raw and activated density differ in rows");
  for_blocks<Real>(raw, [&](Real* values, std::int64_t count, std::int64_t begin) {
    value_inplace(activation, values, count);
    for (std::int64_t i = 0; i < count; ++i) *sigma.row(begin + i) = values[i] * per_m;
  });
}

template <class Real>
void activate_backward(DensityActivation activation, Real per_m, View<const Real> raw, View<const Real> d_sigma,
                       View<Real> d_raw) {
  SEMFIELD_CHECK(raw.rows == d_sigma.rows && raw.rows == d_raw.rows, "density gradients differ in rows");
  for_blocks<Real>(raw, [&](Real* values, std::int64_t count, std::int64_t begin) {
    slope_inplace(activation, values, count);
    for (std::int64_t i = 0; i < count; ++i) *d_raw.row(begin + i) = *d_sigma.row(begin + i) * values[i] * per_m;
  });
}

}  // namespace

template <class Real>
void density_forward(DensityActivation activation, View<const Real> raw, View<Real> sigma) {
  activate<Real>(activation, 1, raw, sigma);
}

template <class Real>
void density_backward(DensityActivation activation, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw) {
  activate_backward<Real>(activation, 1, raw, d_sigma, d_raw);
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
  for (std::int64_t m = 0; m < raw.rows && rule.bias != 0; ++m) raw(m, 0) += static_cast<Real>(rule.bias);
  if (rule.deviation > 0) add_density_noise<Real>(rule.random, rule.first_ray, samples->first, rule.deviation, raw);
  activate<Real>(rule.activation, static_cast<Real>(rule.per_m), raw, sigma);
}

template <class Real>
void density_backward(const DensityRule& rule, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw) {
  activate_backward<Real>(rule.activation, static_cast<Real>(rule.per_m), raw, d_sigma, d_raw);
}

#define SEMFIELD_INSTANTIATE(Real)                                                                            \
  template void density_forward<Real>(DensityActivation, View<const Real>, View<Real>);                       \
  template void density_forward<Real>(const DensityRule&, const Samples<Real>*, View<Real>, View<Real>);      \
  template void density_backward<Real>(DensityActivation, View<const Real>, View<const Real>, View<Real>);    \
  template void density_backward<Real>(const DensityRule&, View<const Real>, View<const Real>, View<Real>);   \
  template void add_density_noise<Real>(const RandomAddress&, std::int64_t, View<const std::int32_t>, double, \
                                        View<Real>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

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

template OpacityResolution opacity_resolution<float>(const Samples<float>&, View<const float>, FarMode, std::int64_t,
                                                     double);
template OpacityResolution opacity_resolution<double>(const Samples<double>&, View<const double>, FarMode, std::int64_t,
                                                      double);

}  // namespace semfield
