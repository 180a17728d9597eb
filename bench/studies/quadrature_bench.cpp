#include "studies/quadrature_bench.h"

#include <algorithm>
#include <cmath>

namespace semfield {

namespace {

constexpr std::int64_t kTimedRays = 64;  // at least, where one ray would do
constexpr std::int64_t kOrderFrom = 64;  // samples from which a measured order counts

// Offsets spread evenly and without a common measure with any grid: multiples of the golden ratio.
std::vector<double> shifts_of(const RayProblem& p, std::int64_t rays) {
  std::vector<double> out;
  for (std::int64_t r = 0; r < rays; ++r) {
    const double turn = static_cast<double>(r) * 0.6180339887498949;
    out.push_back(p.longest_shift * (turn - std::floor(turn)));
  }
  return out;
}

std::vector<QuantityError> errors_of(const RayResults& rays, const std::vector<PerQuantity>& truths) {
  std::vector<QuantityError> out(kQuantities);
  for (std::size_t q = 0; q < kQuantities; ++q) {
    Exact squares = 0, sum = 0;
    for (std::size_t r = 0; r < rays.size(); ++r) {
      const Exact e = Exact(rays[r][q]) - truths[truths.size() == 1 ? 0 : r][q];
      squares += e * e;
      sum += e;
      out[q].max = std::max(out[q].max, static_cast<double>(std::abs(e)));
    }
    const auto count = static_cast<Exact>(rays.size());
    out[q].rms = static_cast<double>(std::sqrt(squares / count));
    out[q].mean = static_cast<double>(sum / count);
  }
  return out;
}

// Slope of log error over log h, least squares, of the points above rounding from kOrderFrom samples on. `error_of` is
// the measured error or a predicted one.
template <class ErrorOf>
std::optional<double> fitted_order(const QuadratureCurve& curve, std::size_t q, ErrorOf&& error_of) {
  const double floor = curve.is_double ? 1e-13 : 1e-5;
  double n = 0, sx = 0, sy = 0, sxx = 0, sxy = 0;
  for (const QuadraturePoint& p : curve.points) {
    if (p.samples < kOrderFrom || p.errors[q].rms < floor) continue;
    const double x = -std::log(static_cast<double>(p.samples)), y = std::log(error_of(p));
    n += 1;
    sx += x;
    sy += y;
    sxx += x * x;
    sxy += x * y;
  }
  if (n < 2) return std::nullopt;
  return (n * sxy - sx * sy) / (n * sxx - sx * sx);
}

}  // namespace

template <class Real>
QuadratureCurve measure_rule(const RayProblem& problem, const QuadratureRule& rule, const QuadratureOptions& options,
                             const Registry& registry) {
  QuadratureCurve curve;
  curve.problem = problem.key;
  curve.rule = rule.name;
  curve.shape = rule.shape;
  curve.is_double = sizeof(Real) == sizeof(double);
  const bool varies = rule.training || !problem.smooth;
  const std::vector<double> shifts = shifts_of(problem, varies ? options.rays : std::min(options.rays, kTimedRays));
  std::vector<PerQuantity> truths;
  for (std::size_t r = 0; r < (problem.smooth ? 1 : shifts.size()); ++r)
    truths.push_back(exact_values(problem, shifts[r]));
  for (const std::int64_t n : options.samples) {
    const Rendered rendered = render_rule<Real>(problem, rule, n, shifts, registry, true);
    curve.points.push_back({n, rendered.evaluations, rendered.seconds, errors_of(rendered.rays, truths)});
  }
  for (std::size_t q = 0; q < kQuantities; ++q) {
    curve.orders.push_back(fitted_order(curve, q, [q](const QuadraturePoint& p) { return p.errors[q].rms; }));
    Prediction prediction = predict(problem, rule.shape, static_cast<Quantity>(q));
    if (rule.guided) prediction = {prediction.order, {}};  // its intervals are not equal
    curve.predictions.push_back(prediction);
  }
  return curve;
}

std::optional<double> predicted_order(const RayProblem& problem, const QuadratureCurve& curve, Quantity quantity) {
  const auto q = static_cast<std::size_t>(quantity);
  const Prediction& expected = curve.predictions[q];
  if (!expected.terms || expected.exact()) return std::nullopt;
  return fitted_order(curve, q, [&](const QuadraturePoint& p) {
    return expected.rms((problem.far_m - problem.near_m) / static_cast<double>(p.samples));
  });
}

std::optional<bool> order_holds(const RayProblem& problem, const QuadratureCurve& curve, Quantity quantity) {
  const auto q = static_cast<std::size_t>(quantity);
  if (!curve.is_double || !curve.predictions[q].terms) return std::nullopt;
  if (curve.predictions[q].exact()) {
    const auto exact = [&](const QuadraturePoint& p) { return p.errors[q].rms < 1e-12; };
    return std::all_of(curve.points.begin(), curve.points.end(), exact);
  }
  const std::optional<double> expected = predicted_order(problem, curve, quantity);
  if (!expected) return std::nullopt;
  const double band = curve.shape == RuleShape::bin_training     ? 0.2
                      : curve.shape == RuleShape::paper_training ? 0.1
                                                                 : 0.05;
  return std::abs(*curve.orders[q] - *expected) <= band;
}

std::optional<Crossing> crossing(const QuadratureCurve& curve, Quantity quantity, double level) {
  const auto q = static_cast<std::size_t>(quantity);
  const std::vector<QuadraturePoint>& points = curve.points;
  std::size_t first = points.size();  // of the points that stay below
  while (first > 0 && points[first - 1].errors[q].rms <= level) --first;
  if (first == points.size()) return std::nullopt;
  const QuadraturePoint& below = points[first];
  if (first == 0) return Crossing{below.evaluations, below.seconds};
  const QuadraturePoint& above = points[first - 1];
  const double from = std::log(above.errors[q].rms), to = std::log(std::max(below.errors[q].rms, 1e-300));
  const double share = (from - std::log(level)) / (from - to);
  const auto between = [&](double a, double b) { return a * std::pow(b / a, share); };
  return Crossing{between(above.evaluations, below.evaluations), between(above.seconds, below.seconds)};
}

std::vector<StiffRow> measure_stiffness(const QuadratureRule& rule, std::int64_t rays, const Registry& registry) {
  constexpr std::int64_t kN = 64;
  std::vector<StiffRow> out;
  for (int power = 0; power <= 8; ++power) {
    const RayProblem p = constant_medium(std::pow(10.0, power));
    const double sigma = std::pow(10.0, power);
    const double h = (p.far_m - p.near_m) / kN, slope = static_cast<double>(p.field->color_slope(0));
    const Rendered rendered = render_rule<double>(p, rule, kN, shifts_of(p, rule.training ? rays : 1), registry, false);
    StiffRow row{rule.name, sigma, errors_of(rendered.rays, {exact_values(p, 0)})[0].rms, {}};
    // Light of an interval comes from its exponential mean; a rule takes the colour of its sample instead.
    const double mean = 1 / sigma - h / std::expm1(sigma * h), lit = -std::expm1(-sigma * (p.far_m - p.near_m));
    if (!rule.guided && rule.shape == RuleShape::left) row.predicted = slope * mean * lit;
    if (!rule.guided && rule.shape == RuleShape::midpoint) row.predicted = slope * std::abs(h / 2 - mean) * lit;
    if (!rule.guided && rule.shape == RuleShape::paper_rendering && sigma * h > 50)
      row.predicted = slope * (h / 2 - 1 / sigma);
    const bool jittered = rule.shape == RuleShape::paper_training || rule.shape == RuleShape::bin_training;
    if (!rule.guided && jittered && sigma * h > 50)  // colour of the first point, evenly spread over the first bin
      row.predicted = slope * std::sqrt(h * h / 3 - h / sigma + 1 / (sigma * sigma));
    out.push_back(row);
  }
  return out;
}

std::vector<ThinSlabRow> measure_thin_slabs(const QuadratureRule& rule, std::int64_t rays, const Registry& registry) {
  constexpr std::int64_t kN = 256;
  std::vector<ThinSlabRow> out;
  for (int power = 0; power <= 5; ++power) {
    // Narrow slabs begin at 0.2 of a bin: inside it, and away from its middle.
    const double h = 9.9 / kN, width = std::pow(10.0, -power), begin = 0.1 + h * 100.2;
    const RayProblem p = thin_slab(begin, width);
    const Rendered rendered = render_rule<double>(p, rule, kN, shifts_of(p, rule.training ? rays : 1), registry, false);
    ThinSlabRow row{rule.name, width, h, 0, 0, {}};
    double squares = 0;
    for (const auto& ray : rendered.rays) row.opacity += ray[1];
    const auto count = static_cast<double>(rendered.rays.size());
    row.opacity /= count;
    for (const auto& ray : rendered.rays) squares += (ray[1] - row.opacity) * (ray[1] - row.opacity);
    if (count > 1) row.standard_error = std::sqrt(squares / (count - 1) / count);
    const bool inside = 0.2 * h + width < h;
    if (!rule.guided && rule.shape == RuleShape::bin_training && inside)
      row.expected = width / h * -std::expm1(-p.stiffness * h);
    out.push_back(row);
  }
  return out;
}

template QuadratureCurve measure_rule<float>(const RayProblem&, const QuadratureRule&, const QuadratureOptions&,
                                             const Registry&);
template QuadratureCurve measure_rule<double>(const RayProblem&, const QuadratureRule&, const QuadratureOptions&,
                                              const Registry&);

}  // namespace semfield
