// Density activations: one loop an activation, so that each is a plain vector loop.
#include "model/density_activation.h"

#include <cmath>

#include "core/check.h"

namespace semfield {
namespace {

template <class Real, class Formula>
void apply(View<const Real> raw, View<Real> out, const Formula& formula) {
  for (std::int64_t i = 0; i < raw.rows; ++i) *out.row(i) = formula(*raw.row(i), i);
}

template <class Real>
Real softplus(Real x) {
  return (x > 0 ? x : Real(0)) + std::log1p(std::exp(-std::abs(x)));
}

// 1 / (1 + e^-x) without overflow on either side.
template <class Real>
Real logistic(Real x) {
  const Real e = std::exp(-std::abs(x));
  return (x >= 0 ? Real(1) : e) / (Real(1) + e);
}

template <class Real>
Real truncated_exp(Real x) {
  return std::exp(x > Real(kTruncExpMax) ? Real(kTruncExpMax) : x);
}

}  // namespace

template <class Real>
void density_forward(DensityActivation activation, View<const Real> raw, View<Real> sigma) {
  SEMFIELD_CHECK(raw.rows == sigma.rows, "raw and activated density differ in rows");
  switch (activation) {
    case DensityActivation::relu:
      // Written so that NaN stays NaN.
      return apply(raw, sigma, [](Real x, std::int64_t) { return x < 0 ? Real(0) : x; });
    case DensityActivation::softplus:
      return apply(raw, sigma, [](Real x, std::int64_t) { return softplus(x); });
    case DensityActivation::trunc_exp:
      return apply(raw, sigma, [](Real x, std::int64_t) { return truncated_exp(x); });
  }
}

template <class Real>
void density_backward(DensityActivation activation, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw) {
  SEMFIELD_CHECK(raw.rows == d_sigma.rows && raw.rows == d_raw.rows, "density gradients differ in rows");
  switch (activation) {
    case DensityActivation::relu:
      return apply(raw, d_raw, [&](Real x, std::int64_t i) { return x > 0 ? *d_sigma.row(i) : Real(0); });
    case DensityActivation::softplus:
      return apply(raw, d_raw, [&](Real x, std::int64_t i) { return *d_sigma.row(i) * logistic(x); });
    case DensityActivation::trunc_exp:
      return apply(raw, d_raw, [&](Real x, std::int64_t i) { return *d_sigma.row(i) * truncated_exp(x); });
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

#define SEMFIELD_INSTANTIATE(Real)                                                                            \
  template void density_forward<Real>(DensityActivation, View<const Real>, View<Real>);                       \
  template void density_backward<Real>(DensityActivation, View<const Real>, View<const Real>, View<Real>);    \
  template void add_density_noise<Real>(const RandomAddress&, std::int64_t, View<const std::int32_t>, double, \
                                        View<Real>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
