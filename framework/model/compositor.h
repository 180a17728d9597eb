// Volume rendering of one tile: from raw density to attenuation, weights, colour, depth, opacity and hidden channels
// along rays, and their gradients.
#pragma once

#include <array>
#include <cstdint>

#include "config/params.h"
#include "core/rng.h"
#include "core/view.h"
#include "plugin/sampler.h"

namespace semfield {

/// tau = sigma * delta; vacuum is vacuum over any distance, so that 0 * inf does not arise.
template <class Real>
SEMFIELD_HD inline double optical_depth(Real sigma, Real delta) {
  return sigma == Real(0) ? 0.0 : static_cast<double>(sigma) * static_cast<double>(delta);
}

/// What a ray meets at its far end. Intervals are what the sampler wrote, in every mode.
///   open        nothing behind: light that passes the last interval shows the background colour (black by default);
///   closed      the medium ends with the last interval: what passes is lost, the background colour is not used;
///   background  the last sample takes the rest: its alpha is 1 whatever its density (the habit of [Mildenhall20]), so
///               its density gets no gradient; a ray without samples shows the background colour.
enum class FarMode : std::uint8_t { open, closed, background };

SEMFIELD_CHOICES(FarMode, "open", "closed", "background");

/// M = samples->count samples of R = samples->first.rows - 1 rays. An empty view is not composited. hidden may cover
/// the first n rays alone: it then has their first[n] samples as rows, and CompositeOut::hidden has n rows.
template <class Real>
struct CompositeIn {
  const Samples<Real>* samples = nullptr;
  View<const Real> sigma{};   ///< [M, 1] after activation, 1/m, >= 0
  View<const Real> rgb{};     ///< [M, 3]
  View<const Real> hidden{};  ///< [M, H]
  FarMode far = FarMode::open;
  std::array<double, 3> background{};  ///< colour of what lies behind; added to colour alone
};

/// Overwritten; an empty view is not wanted, except weight, which backward reads.
template <class Real>
struct CompositeOut {
  View<Real> color{};    ///< [R, 3] sum of w c (+ T_end * background)
  View<Real> depth{};    ///< [R, 1] sum of w t, metres along the ray (not divided by opacity; 0 where nothing is met)
  View<Real> opacity{};  ///< [R, 1] sum of w
  View<Real> hidden{};   ///< [R, H] sum of w h
  View<Real> weight{};   ///< [M, 1] w_k, required
};

/// dL/d(outputs); empty view = zero, and a view with fewer than R rows is zero for the other rays.
template <class Real>
struct CompositeGrad {
  View<const Real> color{};    ///< [R, 3]
  View<const Real> depth{};    ///< [R, 1]
  View<const Real> opacity{};  ///< [R, 1]
  View<const Real> hidden{};   ///< [R, H]
  View<const Real> weight{};   ///< [M, 1], beside what the other ones give a weight
  /// Without CompositeIn::hidden: dL/d(hidden) . h of the samples of the first so many rays (dots, [M, 1]), as
  /// Stages::rounded_sum_backward gives it; on a device it lies in d_sigma.
  std::int64_t dotted_rays = 0;
  View<const Real> dots{};
  bool hidden_moves_density = true;  ///< false: `hidden` reaches d_hidden only, its part of d_sigma is exactly 0
};

/// w_k = T_k alpha_k, alpha_k = -expm1(-sigma_k delta_k), T_k = exp(-sum_{j<k} sigma_j delta_j) [Zhi21 Eq. 2, with the
/// density of sample j inside the sum]. sigma = 0 gives alpha = 0 for any delta, infinite ones included.
/// One thread; each ray's result depends on that ray alone.
template <class Real>
void composite_forward(const CompositeIn<Real>& in, const CompositeOut<Real>& out);

/// `out` is what composite_forward gave (weight alone is read). With v_k = dL/dw_k of sample k, behind the last sample
/// R_{N+1} = what the background gives, and from back to front
///   R_k = R_{k+1} + alpha_k (v_k - R_{k+1}),  dL/dsigma_k = delta_k T_{k+1} (v_k - R_{k+1}),  dL/dc_k = w_k dL/dC.
/// Never total minus prefix: that loses the sign in dense fog. Exactly 0 once T underflows, and for an infinite delta.
/// d_sigma [M, 1], d_rgb [M, 3], d_hidden [M or first[n], H] are overwritten; empty ones are not computed.
template <class Real>
void composite_backward(const CompositeIn<Real>& in, const CompositeOut<Real>& out, const CompositeGrad<Real>& grad,
                        View<Real> d_sigma, View<Real> d_rgb, View<Real> d_hidden);

/// Throws RayFault(failure) for the first density that is negative, infinite or NaN, naming ray (first_ray + its number
/// in the tile), sample within the ray, distance and value.
template <class Real>
void check_density(const Samples<Real>& samples, View<const Real> sigma, std::int64_t first_ray = 0);

// From a field's raw density to attenuation along a ray, and back.

/// f(raw) = sigma per unit of length (1 / DensityRule::per_m):
///   relu       max(raw, 0), f' = 1 for raw > 0, else 0 [Mildenhall20];
///   softplus   ln(1 + e^raw) = max(raw, 0) + log1p(e^-|raw|), f' = 1 / (1 + e^-raw);
///   trunc_exp  e^min(raw, 15) [Mueller22]: 3.3e6 is opaque within a millionth of the unit. f' = e^min(raw, 15): above
///              the clamp the slope at the clamp is used, so that a saturated density is finite and can still come
///              down.
/// Non-finite raw values pass through as non-finite (relu keeps NaN): check_density names them, nothing hides them.
enum class DensityActivation : std::uint8_t { relu, softplus, trunc_exp };

SEMFIELD_CHOICES(DensityActivation, "relu", "softplus", "trunc_exp");

/// Largest exponent of trunc_exp.
inline constexpr double kTruncExpMax = 15;

/// From raw density to sigma = f(raw + bias + noise) * per_m. The length keeps what a network has to say the same in
/// every unit that a scene may be measured in.
struct DensityRule {
  DensityActivation activation = DensityActivation::relu;
  double per_m = 1;        ///< 1 / RenderRules::unit_m
  double bias = 0;         ///< added to raw density
  double deviation = 0;    ///< of the noise; 0: none
  RandomAddress random{};  ///< of the noise
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
///                    at that distance, gave the opacity. The surface lies anywhere within them, and matter as thin as
///                    the pixel grid could show is seen with the chance of width / delta alone;
///   resolved         else.
/// `weight` [M, 1] of `samples`.
template <class Real>
OpacityResolution opacity_resolution(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                                     std::int64_t ray, double footprint_per_m);

}  // namespace semfield
