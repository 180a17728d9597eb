// Error of the rendering integral against field evaluations and CPU time: the samplers' rules with the real
// compositor, and rules of the literature beside them, on media whose integrals are known.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "studies/quadrature_rays.h"

namespace semfield {

/// Errors of one quantity over rays.
struct QuantityError {
  double max = 0, rms = 0, mean = 0;
};

struct QuadraturePoint {
  std::int64_t samples = 0;           ///< N, of the composited pass
  double evaluations = 0;             ///< of the field, a ray
  double seconds = 0;                 ///< of one core, a ray: sampling, the medium's formulas, compositing
  std::vector<QuantityError> errors;  ///< [kQuantities]
};

struct QuadratureCurve {
  std::string problem, rule;
  RuleShape shape = RuleShape::midpoint;
  bool is_double = false;
  std::vector<QuadraturePoint> points;
  std::vector<std::optional<double>> orders;  ///< [kQuantities] of the rms error; empty: at rounding throughout
  std::vector<Prediction> predictions;        ///< [kQuantities]
};

struct QuadratureOptions {
  std::vector<std::int64_t> samples{8, 16, 32, 64, 128, 256, 512, 1024};
  std::int64_t rays = 1024;  ///< for rules with jitter and media with jumps; the others need one, and time 64
};

/// Throws Error(config) when no registered sampler has a parameter `quadrature`.
template <class Real>
QuadratureCurve measure_rule(const RayProblem& problem, const QuadratureRule& rule, const QuadratureOptions& options,
                             const Registry& registry);

/// The predicted order over the same numbers of samples as the measured one: the slope of the predicted rms error.
/// Empty: there are no terms, or the rule is exact.
std::optional<double> predicted_order(const RayProblem& problem, const QuadratureCurve& curve, Quantity quantity);

/// A measured order against predicted_order: within 0.05 (fixed points), 0.1 (jittered, at near ends), 0.2 (jittered in
/// bins); a rule that is exact must be so to rounding. Empty: nothing was predicted that could be compared.
std::optional<bool> order_holds(const RayProblem& problem, const QuadratureCurve& curve, Quantity quantity);

/// The fewest evaluations, and seconds per ray, at which the rms error of a quantity stays below `level`: from there on
/// every finer point lies below, between two points the logarithms are interpolated.
struct Crossing {
  double evaluations = 0, seconds = 0;
};
std::optional<Crossing> crossing(const QuadratureCurve& curve, Quantity quantity, double level);

/// Colour error of a rule in a constant medium with c = t/4, 64 samples on [0, 4], and what the rule must give.
struct StiffRow {
  std::string rule;
  double sigma = 0, error = 0;
  std::optional<double> predicted;  ///< rms; empty: not derived
};
std::vector<StiffRow> measure_stiffness(const QuadratureRule& rule, std::int64_t rays, const Registry& registry);

/// Mean opacity of a slab of optical depth 10, 256 samples on [0.1, 10]; its true value is 1 - e^-10.
struct ThinSlabRow {
  std::string rule;
  double width_m = 0, interval_m = 0, opacity = 0, standard_error = 0;
  std::optional<double> expected;  ///< mean that the rule must have
};
std::vector<ThinSlabRow> measure_thin_slabs(const QuadratureRule& rule, std::int64_t rays, const Registry& registry);

}  // namespace semfield
