// What `semfield-study quadrature` measures and says: tables, omissions, plots and JSON of measured rules.
#pragma once

#include <string>
#include <vector>

#include "studies/quadrature_bench.h"
#include "studies/study_tools.h"

namespace semfield {

struct QuadratureResults {
  std::vector<RayProblem> problems;
  std::vector<QuadratureRule> rules;
  std::vector<QuadratureCurve> curves;  ///< of every problem and rule, in double, then in float
  std::vector<StiffRow> stiff;
  std::vector<ThinSlabRow> thin;
  long long rays = 0;

  const QuadratureCurve& at(const std::string& problem, const std::string& rule, bool is_double) const;
};

/// Every problem, rule and precision; `rays` for rules with jitter and media with jumps.
QuadratureResults measure_quadrature(long long rays, const StudyTools& tools);

/// Orders that hold, and that were predicted and measured.
struct OrderCount {
  int held = 0, compared = 0;
};
OrderCount count_orders(const QuadratureResults& results);

/// Markdown, readable as it stands.
std::string quadrature_tables(const QuadratureResults& results);
/// Which rule failed where, and why.
std::string quadrature_omissions(const QuadratureResults& results);
std::string quadrature_json(const QuadratureResults& results);
/// Colour error of one problem: float64 above float32, against evaluations on the left and seconds on the right.
std::string quadrature_figure(const QuadratureResults& results, const RayProblem& problem);

}  // namespace semfield
