// Loss `distortion`: light of a ray comes from one place [Barron22, Eq. 15].
#pragma once

#include "core/view.h"
#include "plugin/loss.h"

namespace semfield {

/// How distances are brought to [0, 1] between the ray's own near and far.
///   linear     (t - near) / (far - near);
///   disparity  the same of 1 / t, which spreads what is close [Barron22].
enum class DistortionSpace : std::uint8_t { linear, disparity };
SEMFIELD_CHOICES(DistortionSpace, "linear", "disparity");

struct DistortionParams : LossRule {
  DistortionParams() {
    weight = 0.002;
    from_step = 0.2;
  }
  DistortionSpace space = DistortionSpace::linear;
};

void describe(ParamVisitor& visit, DistortionParams& params);

// The formulas of the distortion loss, for CPU and GPU.
//
// L = sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 d_i [Barron22, Eq. 15] of a ray, s the samples' places in [0, 1] and
// d the lengths of their intervals there. With s ascending and P_k = sum_{j<k} w_j (s_k - s_j), Q_k the same from
// behind,
//   L = 2 sum_k w_k P_k + 1/3 sum_k w_k^2 d_k,  dL/dw_k = 2 (P_k + Q_k) + 2/3 w_k d_k.
// P and Q are summed from their own end, P_k = P_{k-1} + (s_k - s_{k-1}) sum_{j<k} w_j: no differences of large sums.

/// A ray's map of distances to [0, 1]. Distances beyond its ends count as the ends.
struct DistortionMap {
  double near_m = 0, far_m = 1, from = 0, factor = 1;
  bool disparity = false;

  SEMFIELD_HD DistortionMap(DistortionSpace space, double near_in, double far_in)
      : near_m(near_in), far_m(far_in), disparity(space == DistortionSpace::disparity) {
    if (disparity && near_m < 1e-3 * far_m) near_m = 1e-3 * far_m;  // the disparity of the eye itself is infinite
    const double a = disparity ? 1 / near_m : near_m, b = disparity ? 1 / far_m : far_m;
    from = a;
    factor = near_m < far_m ? 1 / (b - a) : 0;
  }
  SEMFIELD_HD double place(double t) const {
    const double inside = t < near_m ? near_m : t > far_m ? far_m : t;
    return ((disparity ? 1 / inside : inside) - from) * factor;
  }
  /// Length of the interval `delta` about t. An infinite one ends at far.
  SEMFIELD_HD double length(double t, double delta) const { return place(t + 0.5 * delta) - place(t - 0.5 * delta); }
};

/// Sums over the samples that a walk along the ray, from either end, has behind it.
struct DistortionWalk {
  double weight = 0, moment = 0, place = 0;  // sum of w, P of the last sample, its s

  /// P (or Q) of the next sample.
  SEMFIELD_HD double step(double next_place, double next_weight) {
    const double gap = next_place > place ? next_place - place : place - next_place;
    moment += weight * gap;  // without a sample so far the weight is 0, wherever it starts
    weight += next_weight;
    place = next_place;
    return moment;
  }
};

class DistortionLoss final : public LossOf<DistortionLoss, DistortionParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override { return {.moves = {channel::weight}}; }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    double sum = 0;
    for (std::int64_t r = 0; r + 1 < values.first.rows; ++r) {
      const std::int32_t begin = values.first(r, 0), end = values.first(r + 1, 0);
      const DistortionMap map(params.space, values.near_far(r, 0), values.near_far(r, 1));
      DistortionWalk front, back;
      double of_ray = 0;
      for (std::int32_t m = begin; m < end; ++m) {
        const auto w = static_cast<double>(values.weight(m, 0)), t = static_cast<double>(values.t(m, 0));
        const double length = map.length(t, static_cast<double>(values.delta(m, 0)));
        const double before = front.step(map.place(t), w);
        of_ray += w * (2 * before + w * length / 3);
        gradients.weight(m, 0) += static_cast<Real>(scale * 2 * (before + w * length / 3));
      }
      for (std::int32_t m = end; m-- > begin;) {
        const auto w = static_cast<double>(values.weight(m, 0)), t = static_cast<double>(values.t(m, 0));
        gradients.weight(m, 0) += static_cast<Real>(scale * 2 * back.step(map.place(t), w));
      }
      sum += of_ray;
    }
    return sum;
  }
};

}  // namespace semfield
