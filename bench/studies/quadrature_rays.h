// Rays through analytic media, by the registered samplers and the real compositor, and by rules of the literature.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "plugin/registry.h"
#include "studies/quadrature_problems.h"

namespace semfield {

/// One way to place samples. With a sampler it is what trains and renders: the registered plugin, then
/// composite_forward. Without, it is a rule of the literature, written down in quadrature_rays.cpp to compare with.
struct QuadratureRule {
  std::string name;  ///< "midpoint", "paper, training"
  RuleShape shape = RuleShape::midpoint;
  std::string sampler;  ///< registered name; "": not a sampler of ours
  std::string choice;   ///< value of its parameter `quadrature`
  bool training = false;
  bool guided = false;  ///< a second pass, drawn by the weights of a first one of a quarter of its samples
};

/// Every rule of every registered sampler that has the parameters `samples` and `quadrature`, jittered and not where
/// that differs, then the literature's: left grid, trapezoid, linear colour, Gauss of two points.
std::vector<QuadratureRule> quadrature_rules(const Registry& registry);

/// What some rays show: kQuantities numbers each.
using RayResults = std::vector<std::array<double, kQuantities>>;

struct Rendered {
  RayResults rays;
  double evaluations = 0;  ///< of the field, a ray
  double seconds = 0;      ///< of one core, a ray: sampling, the medium's formulas, compositing
};

/// One ray for each shift, by `samples` samples; ray r has number r, which addresses its jitter. `timed` repeats short
/// measurements and keeps the shortest. Throws Error(config) when no registered sampler can propose to a guided rule.
template <class Real>
Rendered render_rule(const RayProblem& problem, const QuadratureRule& rule, std::int64_t samples,
                     const std::vector<double>& shifts, const Registry& registry, bool timed);

}  // namespace semfield
