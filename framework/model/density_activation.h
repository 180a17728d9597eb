// From a field's raw density to attenuation along a ray, and back.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>

#include "config/params.h"
#include "core/rng.h"
#include "core/view.h"
#include "model/compositor.h"
#include "plugin/sampler.h"

namespace semfield {

/// f(raw) = sigma per unit of length (1 / DensityRule::per_m):
///   relu       max(raw, 0), f' = 1 for raw > 0, else 0 [Mildenhall20];
///   softplus   ln(1 + e^raw) = max(raw, 0) + log1p(e^-|raw|), f' = 1 / (1 + e^-raw);
///   trunc_exp  e^min(raw, 15) [Mueller22]: 3.3e6 is opaque within a millionth of the unit. f' = e^min(raw, 15): above
///              the clamp the slope at the clamp is used, so that a saturated density is finite and can still come
///              down.
/// Non-finite raw values pass through as non-finite (relu keeps NaN): check_density names them, nothing hides them.
enum class DensityActivation : std::uint8_t { relu, softplus, trunc_exp };

template <>
struct ChoiceNames<DensityActivation> {
  static constexpr std::array<std::string_view, 3> names{"relu", "softplus", "trunc_exp"};
};

/// Largest exponent of trunc_exp.
inline constexpr double kTruncExpMax = 15;

/// sigma = f(raw), elementwise; [M, 1] each; raw and sigma may be the same memory only when no backward follows.
template <class Real>
void density_forward(DensityActivation activation, View<const Real> raw, View<Real> sigma);

/// d_raw = d_sigma * f'(raw), elementwise; [M, 1] each; d_raw may be the memory of d_sigma.
template <class Real>
void density_backward(DensityActivation activation, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw);

/// From raw density to sigma = f(raw + bias + noise) * per_m. The length keeps what a network has to say the same in
/// every unit that a scene may be measured in.
struct DensityRule {
  DensityActivation activation = DensityActivation::relu;
  double per_m = 1;      ///< 1 / RenderRules::unit_m
  double bias = 0;       ///< added to raw density
  double deviation = 0;  ///< of the noise; 0: none
  RandomAddress random;  ///< of the noise
  std::int64_t first_ray = 0;
};
/// [M, 1] each; raw is overwritten with what f saw. samples may be null without noise.
template <class Real>
void density_forward(const DensityRule& rule, const Samples<Real>* samples, View<Real> raw, View<Real> sigma);

/// d_raw = d_sigma * f'(raw) * per_m, [M, 1] each, raw as density_forward left it; d_raw may be the memory of d_sigma.
template <class Real>
void density_backward(const DensityRule& rule, View<const Real> raw, View<const Real> d_sigma, View<Real> d_raw);

/// raw += deviation * N(0, 1) (training noise of preset `paper` [Mildenhall20]). Sample k of ray r draws at index
/// (first_ray + r) * 2^20 + k, so the values do not depend on how rays are cut into tiles. raw [M, 1]; first [R + 1,
/// 1].
template <class Real>
void add_density_noise(const RandomAddress& address, std::int64_t first_ray, View<const std::int32_t> first,
                       double deviation, View<Real> raw);

// Whether the steps along a ray were short enough for what it met.

enum class OpacityResolution : std::uint8_t { clear, resolved, under_resolved };

/// What the weights of a ray say: their sum, the two largest, and the first sample that has the largest.
struct OpacitySums {
  double opacity = 0, first = 0, second = 0;
  std::int32_t at = 0;
};
/// The rule of opacity_resolution; t and delta are those of sample `at`.
SEMFIELD_HD inline OpacityResolution resolution_of(const OpacitySums& sums, double t, double delta,
                                                   double footprint_per_m) {
  constexpr double kMet = 0.5, kMostOfIt = 0.9;
  if (sums.opacity < kMet) return OpacityResolution::clear;
  const bool coarse = sums.first + sums.second >= kMostOfIt * sums.opacity && delta > footprint_per_m * t;
  return coarse ? OpacityResolution::under_resolved : OpacityResolution::resolved;
}

/// With O the opacity of a ray (without the last sample's weight under FarMode::background, which is no density), a and
/// b its two largest weights, and delta_a, t_a the interval and distance of a:
///   clear            O < 1/2: the ray met little;
///   under_resolved   a + b >= 0.9 O and delta_a > footprint_per_m t_a: at most two steps, longer than a pixel is wide
///   at
///                    that distance, gave the opacity. The surface lies anywhere within them, and matter as thin as the
///                    pixel grid could show is seen with the chance of width / delta alone;
///   resolved         else.
/// `weight` [M, 1] of `samples`.
template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m);

}  // namespace semfield
