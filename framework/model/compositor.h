// Volume rendering of one tile: weights, colour, depth, opacity and hidden channels along rays, and their gradients.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>

#include "config/params.h"
#include "core/host_device.h"
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

template <>
struct ChoiceNames<FarMode> {
  static constexpr std::array<std::string_view, 3> names{"open", "closed", "background"};
};

/// M = samples->count samples of R = samples->first.rows - 1 rays. An empty view is not composited. hidden may cover
/// the first n rays alone: it then has their first[n] samples as rows, and CompositeOut::hidden has n rows.
template <class Real>
struct CompositeIn {
  const Samples<Real>* samples = nullptr;
  View<const Real> sigma;   ///< [M, 1] after activation, 1/m, >= 0
  View<const Real> rgb;     ///< [M, 3]
  View<const Real> hidden;  ///< [M, H]
  FarMode far = FarMode::open;
  std::array<double, 3> background{};  ///< colour of what lies behind; added to colour alone
};

/// Overwritten; an empty view is not wanted, except weight, which backward reads.
template <class Real>
struct CompositeOut {
  View<Real> color;    ///< [R, 3] sum of w c (+ T_end * background)
  View<Real> depth;    ///< [R, 1] sum of w t, metres along the ray (not divided by opacity; 0 where nothing is met)
  View<Real> opacity;  ///< [R, 1] sum of w
  View<Real> hidden;   ///< [R, H] sum of w h
  View<Real> weight;   ///< [M, 1] w_k, required
};

/// dL/d(outputs); empty view = zero, and a view with fewer than R rows is zero for the other rays.
template <class Real>
struct CompositeGrad {
  View<const Real> color;    ///< [R, 3]
  View<const Real> depth;    ///< [R, 1]
  View<const Real> opacity;  ///< [R, 1]
  View<const Real> hidden;   ///< [R, H]
  View<const Real> weight;   ///< [M, 1], beside what the other ones give a weight
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

}  // namespace semfield
