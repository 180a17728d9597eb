// A term of the loss beside colour and semantics: what it sees of a batch of rays, what it answers, and its parameters.
#pragma once

#include <cstdint>
#include <memory>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "config/typed_params.h"
#include "core/error.h"
#include "core/view.h"

namespace semfield {

/// What the rays of a batch, or of a tile of one, are compared with; R rows each, empty: not known.
struct RayTargets {
  View<const float> color;         ///< [R, 3] in [0, 1]
  View<const std::int16_t> label;  ///< [R, 1] class or kVoid
  View<const float> soft;          ///< [R, C] probabilities; empty where labels are hard
  View<const float> depth;         ///< [R, 1] metres along the ray; 0: unknown
};

/// What a pass makes of the rays. M samples: row m of t, delta, sigma and weight.
template <class Real>
struct RayValues {
  View<const double> near_far;     ///< [R, 2] metres along the ray; near == far: an empty ray
  View<const std::int32_t> first;  ///< [R+1, 1]: ray r owns samples first[r] .. first[r+1] - 1, t ascending
  View<const Real> t, delta;       ///< metres along the ray, and length of the sample's interval
  View<const Real> sigma;          ///< 1/m, after activation
  View<const Real> weight;         ///< compositing weights
  View<const Real> color;          ///< [R, 3]
  View<const Real> depth;          ///< [R, 1] sum of w t, metres along the ray
  View<const Real> opacity;        ///< [R, 1] sum of w
};

/// dL/d(values). Terms add to them; those that no term's traits name may be empty.
template <class Real>
struct RayGradients {
  View<Real> color;   ///< [R, 3]
  View<Real> depth;   ///< [R, 1]
  View<Real> weight;  ///< [M, 1]; a gradient of opacity is the same value at all samples of the ray
  View<Real> sigma;   ///< [M, 1] direct, beside what the other gradients make of it
};

/// A loss and its slope.
struct LossValue {
  double value = 0, slope = 0;
};

/// What every term of the list has.
struct LossRule {
  double weight = 0;     ///< factor beside the colour loss
  double from_step = 0;  ///< share of train.steps (step_of_share)
};

struct LossTraits {
  bool reads_depth = false;  ///< needs RayTargets::depth
  /// Gradients that it adds to.
  bool moves_color = false, moves_depth = false, moves_weight = false, moves_sigma = false;
  bool any() const { return moves_color || moves_depth || moves_weight || moves_sigma; }
};

class LossTerm {
 public:
  virtual ~LossTerm() = default;
  LossRule rule;

  void describe(ParamVisitor& visit);
  virtual void validate(Diagnostics&) const {}
  virtual LossTraits traits() const = 0;
  /// Rays of a whole batch that the mean is taken over; 0: the term is 0 for the batch.
  virtual std::int64_t counted_rays(const RayTargets&, std::int64_t rays) const { return rays; }
  /// Sum over the rays, before weight and division, and `scale` times its gradients into `gradients`. One thread; a
  /// ray's share depends on that ray alone. Samples are views of a whole tile; `first` holds places in them.
  virtual double add(const RayTargets& targets, const RayValues<float>& values, double scale,
                     const RayGradients<float>& gradients) const = 0;
  virtual double add(const RayTargets& targets, const RayValues<double>& values, double scale,
                     const RayGradients<double>& gradients) const = 0;

 protected:
  virtual void describe_own(ParamVisitor& visit) = 0;
};

namespace loss_detail {
/// `describe` of a term's parameters, out of sight of LossTerm::describe.
template <class Params>
void describe_params(ParamVisitor& visit, Params& params) {
  describe(visit, params);
}
}  // namespace loss_detail

/// Base of a term with parameters, declared by a function describe(ParamVisitor&, Params&), whose one code for both
/// precisions is `template <class Real> double sum(targets, values, scale, gradients)`.
template <class Term, class Params>
class LossTermOf : public LossTerm {
 public:
  Params params;

  double add(const RayTargets& targets, const RayValues<float>& values, double scale,
             const RayGradients<float>& gradients) const final {
    return static_cast<const Term&>(*this).template sum<float>(targets, values, scale, gradients);
  }
  double add(const RayTargets& targets, const RayValues<double>& values, double scale,
             const RayGradients<double>& gradients) const final {
    return static_cast<const Term&>(*this).template sum<double>(targets, values, scale, gradients);
  }

 protected:
  void describe_own(ParamVisitor& visit) final { loss_detail::describe_params(visit, params); }
};

/// A type that `losses` may name, one a folder of framework/losses; `cost` is what its absence saves.
struct LossKind : TypeOf<LossTerm> {
  std::string_view cost;
  bool cuda = false;  ///< has kernels for CUDA devices; the build says so
};

/// Every one of them, in the order of their names; the build writes the list.
const std::vector<LossKind>& loss_kinds();

}  // namespace semfield
