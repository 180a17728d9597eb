#include "studies/quadrature_report.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <nlohmann/json.hpp>

#include "core/check.h"
#include "report/html.h"
#include "run/run_folder.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

constexpr std::array<double, 3> kLevels{2e-3, 1e-4, 1e-6};
constexpr double kPlotFloor = 1e-9;  // errors below it are left out of the plots

using Table = std::vector<std::vector<std::string>>;

// Markdown whose columns line up; the first row is the head.
std::string table_text(const Table& rows) {
  std::vector<std::size_t> width(rows.front().size());
  for (const auto& row : rows) {
    for (std::size_t c = 0; c < row.size(); ++c) width[c] = std::max(width[c], row[c].size());
  }
  std::string out;
  for (std::size_t r = 0; r < rows.size(); ++r) {
    for (std::size_t c = 0; c < width.size(); ++c) out += fmt::format("| {:<{}} ", rows[r][c], width[c]);
    out += "|\n";
    if (r > 0) continue;
    for (const std::size_t w : width) out += "|" + std::string(w + 2, '-');
    out += "|\n";
  }
  return out;
}

std::string error_text(double value) { return value == 0 ? "0" : fmt::format("{:.1e}", value); }

// Measured beside predicted over the same range: "1.99 (2.00)"; "exact" where both say so; "!" where they disagree.
std::string order_text(const RayProblem& problem, const QuadratureCurve& curve, std::size_t q) {
  const auto quantity = static_cast<Quantity>(q);
  const Prediction& p = curve.predictions[q];
  const std::optional<double> expected = predicted_order(problem, curve, quantity);
  const std::string predicted = p.exact()  ? "exact"
                                : expected ? fmt::format("{:.2f}", *expected)
                                           : fmt::format("{:g}", p.order);
  const std::string mark = order_holds(problem, curve, quantity).value_or(true) ? "" : " !";
  if (!curve.orders[q]) return fmt::format("{} ({}){}", p.exact() ? "exact" : "at rounding", predicted, mark);
  return fmt::format("{:.2f} ({}){}", *curve.orders[q], predicted, mark);
}

// rms error at the finest grid over the predicted one.
std::string ratio_text(const RayProblem& problem, const QuadratureCurve& curve, std::size_t q) {
  const Prediction& p = curve.predictions[q];
  const QuadraturePoint& last = curve.points.back();
  if (!p.terms || p.exact() || !curve.orders[q]) return "-";
  return fmt::format("{:.3f}",
                     last.errors[q].rms / p.rms((problem.far_m - problem.near_m) / static_cast<double>(last.samples)));
}

std::string crossing_text(const std::optional<Crossing>& c) {
  return c ? fmt::format("{:.0f}, {:.2f} us", c->evaluations, 1e6 * c->seconds) : "never";
}

std::string rule_text(const QuadratureRule& rule) { return rule.sampler.empty() ? rule.name + " *" : rule.name; }

std::string problem_tables(const QuadratureResults& r, const RayProblem& problem) {
  Table orders{{"rule", "colour", "opacity", "depth", "class probability", "error / predicted"}};
  Table errors{{"rule", "rms 64", "max 64", "rms 1024", "max 1024", "float32 rms 1024", "2e-3", "1e-4", "1e-6"}};
  const auto q = static_cast<std::size_t>(Quantity::color);
  for (const QuadratureRule& rule : r.rules) {
    const QuadratureCurve& c = r.at(problem.key, rule.name, true);
    orders.push_back({rule_text(rule), order_text(problem, c, 0), order_text(problem, c, 1), order_text(problem, c, 2),
                      order_text(problem, c, 3), ratio_text(problem, c, q)});
    const auto middle =
        std::find_if(c.points.begin(), c.points.end(), [](const QuadraturePoint& p) { return p.samples == 64; });
    SEMFIELD_CHECK(middle != c.points.end(), "64 samples are not among those measured");
    const QuantityError &coarse = middle->errors[q], &fine = c.points.back().errors[q];
    std::vector<std::string> row{
        rule_text(rule),        error_text(coarse.rms),
        error_text(coarse.max), error_text(fine.rms),
        error_text(fine.max),   error_text(r.at(problem.key, rule.name, false).points.back().errors[q].rms)};
    for (const double level : kLevels) row.push_back(crossing_text(crossing(c, Quantity::color, level)));
    errors.push_back(std::move(row));
  }
  return fmt::format(
      "\n## {}\n\nOrders of the rms error, measured (predicted), float64:\n\n{}\n"
      "Error of colour; evaluations and time per ray from which the rms error stays below a mark:\n\n{}",
      problem.name, table_text(orders), table_text(errors));
}

std::string stiff_table(const QuadratureResults& r) {
  Table rows{{"rule"}};
  std::map<std::string, std::size_t> row_of;
  for (const StiffRow& s : r.stiff) {
    if (s.rule == r.rules.front().name) rows[0].push_back(fmt::format("sigma {:.0e}", s.sigma));
    if (!row_of.contains(s.rule)) {
      row_of[s.rule] = rows.size();
      rows.push_back({s.rule});
    }
    rows[row_of[s.rule]].push_back(s.predicted ? fmt::format("{:.2e} ({:.2e})", s.error, *s.predicted)
                                               : fmt::format("{:.2e}", s.error));
  }
  return "\n## Stiff: constant sigma, c = t/4, 64 samples on [0, 4]\n\nrms error of colour (predicted):\n\n" +
         table_text(rows);
}

std::string thin_table(const QuadratureResults& r) {
  Table rows{{"rule"}};
  std::map<std::string, std::size_t> row_of;
  for (const ThinSlabRow& s : r.thin) {
    if (s.rule == r.rules.front().name) {
      rows[0].push_back(fmt::format("{:g} m{}", s.width_m, s.width_m < s.interval_m ? ", thinner than h" : ""));
    }
    if (!row_of.contains(s.rule)) {
      row_of[s.rule] = rows.size();
      rows.push_back({s.rule});
    }
    std::string text = fmt::format("{:.5f}", s.opacity);
    if (s.standard_error > 0) text += fmt::format(" +- {:.5f}", s.standard_error);
    if (s.expected) text += fmt::format(" ({:.5f})", *s.expected);
    rows[row_of[s.rule]].push_back(std::move(text));
  }
  return fmt::format(
             "\n## Slabs of optical depth 10 on [0.1, 10], 256 samples (h = {:.4f} m)\n\n"
             "Mean opacity, its standard error over rays, and the mean that the rule must have; true: {:.5f}\n\n",
             r.thin.empty() ? 0 : r.thin.front().interval_m, -std::expm1(-10.0)) +
         table_text(rows);
}

// A plot holds what can be told apart: trapezoid and linear colour lie on the midpoint's line, the left grid and guided
// near ends beside the paper's. The tables have them all.
bool drawn(const QuadratureRule& rule) {
  return rule.shape != RuleShape::left && !(rule.sampler.empty() && rule.shape == RuleShape::second);
}

std::string joined(const std::vector<std::string>& names) {
  std::string out;
  for (const std::string& name : names) out += (out.empty() ? "" : "; ") + name;
  return out;
}

// Why a rule misses 1e-4 in a problem at the finest grid; "" when it does not.
std::string reason_of(const RayProblem& problem, const QuadratureRule& rule, const QuadratureCurve& c) {
  const QuadraturePoint& last = c.points.back();
  const double error = last.errors[0].rms;
  if (error <= 1e-4) return "";
  const double order = c.orders[0].value_or(0);
  if (!problem.smooth && rule.shape == RuleShape::fourth && order < 0.5) {
    return fmt::format(
        "does not converge: the integrand is a spike of width 1/sigma = {:.0e} m that its points miss "
        "until h < 1/sigma",
        1 / problem.stiffness);
  }
  if (!problem.smooth)
    return "order 1 at best: a sample decides for its whole interval on which side of a jump it lies";
  return "order 1: the near end of an interval speaks for all of it, and the jittered start of the ray is skipped";
}

}  // namespace

QuadratureResults measure_quadrature(long long rays, const StudyTools& tools) {
  QuadratureResults results;
  results.problems = quadrature_problems();
  results.rules = quadrature_rules(tools.registry);
  results.rays = rays;
  QuadratureOptions how;
  how.rays = rays;
  for (const RayProblem& problem : results.problems) {
    tools.note(problem.name);
    for (const QuadratureRule& rule : results.rules) {
      results.curves.push_back(measure_rule<double>(problem, rule, how, tools.registry));
      results.curves.push_back(measure_rule<float>(problem, rule, how, tools.registry));
    }
  }
  tools.note("stiff media and thin slabs");
  for (const QuadratureRule& rule : results.rules) {
    for (const StiffRow& row : measure_stiffness(rule, rays, tools.registry)) results.stiff.push_back(row);
    for (const ThinSlabRow& row : measure_thin_slabs(rule, 8 * rays, tools.registry)) results.thin.push_back(row);
  }
  return results;
}

const QuadratureCurve& QuadratureResults::at(const std::string& problem, const std::string& rule,
                                             bool is_double) const {
  const auto found = std::find_if(curves.begin(), curves.end(), [&](const QuadratureCurve& c) {
    return c.problem == problem && c.rule == rule && c.is_double == is_double;
  });
  SEMFIELD_CHECK(found != curves.end(), "no curve of this problem and rule");
  return *found;
}

OrderCount count_orders(const QuadratureResults& r) {
  OrderCount count;
  for (const RayProblem& problem : r.problems) {
    for (const QuadratureRule& rule : r.rules) {
      for (std::size_t q = 0; q < kQuantities; ++q) {
        const auto held = order_holds(problem, r.at(problem.key, rule.name, true), static_cast<Quantity>(q));
        if (!held) continue;
        ++count.compared;
        if (*held) ++count.held;
      }
    }
  }
  return count;
}

std::string quadrature_tables(const QuadratureResults& r) {
  std::string out = fmt::format(
      "# Rules of the rendering integral\n\n8 to 1024 samples; {} rays where a rule is jittered or a medium has jumps. "
      "Rules with * are not samplers of ours. Time is that of one core, a ray: sampling, the medium's formulas, "
      "compositing.\n",
      r.rays);
  for (const RayProblem& problem : r.problems) out += problem_tables(r, problem);
  return out + stiff_table(r) + thin_table(r);
}

std::string quadrature_omissions(const QuadratureResults& r) {
  std::string out;
  for (const RayProblem& problem : r.problems) {
    std::vector<std::string> reasons;  // in order of appearance
    std::map<std::string, std::vector<std::string>> rules;
    for (const QuadratureRule& rule : r.rules) {
      const QuadratureCurve& c = r.at(problem.key, rule.name, true);
      const std::string reason = reason_of(problem, rule, c);
      if (reason.empty()) continue;
      if (!rules.contains(reason)) reasons.push_back(reason);
      rules[reason].push_back(fmt::format("{} ({:.1e})", rule.name, c.points.back().errors[0].rms));
    }
    for (const std::string& reason : reasons)
      out +=
          fmt::format("- {}: not below 1e-4 with 1024 samples: {}. {}.\n", problem.name, joined(rules[reason]), reason);
  }
  std::vector<std::string> blind, chance;
  for (const QuadratureRule& rule : r.rules) {
    double least = 1;
    bool random = false;
    for (const ThinSlabRow& row : r.thin) {
      if (row.rule != rule.name || row.width_m > row.interval_m / 2) continue;
      least = std::min(least, row.opacity);
      random = random || row.standard_error > 0;
    }
    if (least > 0.5) continue;
    (random ? chance : blind).push_back(rule.name);
  }
  out += fmt::format(
      "- slabs thinner than the interval h: under-resolved. Fixed points that miss the slab miss it on "
      "every ray: {}. Jittered ones meet it on a share w/h of the rays and then take it for h thick, so "
      "the mean opacity falls with w: {}.\n",
      joined(blind), joined(chance));
  double worst = 0;
  for (const QuadratureCurve& c : r.curves) {
    if (c.is_double || r.problems.front().key != c.problem) continue;
    worst = std::max(worst, c.points.back().errors[1].rms);
  }
  std::vector<std::string> stiff;
  for (const StiffRow& row : r.stiff) {
    if (row.sigma == 1e4 && row.error > 1e-3) stiff.push_back(fmt::format("{} ({:.0e})", row.rule, row.error));
  }
  out += fmt::format(
      "- sigma h >> 1: light comes from a layer 1/sigma thick at the start of an interval, but the colour "
      "is taken elsewhere in it: order 2 becomes order 1. At sigma = 1e4 and 64 samples: {}.\n",
      joined(stiff));
  return out;
}

std::string quadrature_json(const QuadratureResults& r) {
  Json out = Json::parse(environment_json(this_environment()));
  out["rays"] = r.rays;
  out["curves"] = Json::array();
  for (const QuadratureCurve& c : r.curves) {
    Json curve{{"problem", c.problem}, {"rule", c.rule}, {"precision", c.is_double ? "float64" : "float32"}};
    for (const QuadratureRule& rule : r.rules) {
      if (rule.name == c.rule) curve["sampler"] = rule.sampler.empty() ? Json(nullptr) : Json(rule.sampler);
    }
    for (std::size_t q = 0; q < kQuantities; ++q) {
      const Prediction& p = c.predictions[q];
      Json& row = curve["orders"][kQuantityNames[q]];
      row["measured"] = c.orders[q] ? Json(*c.orders[q]) : Json(nullptr);
      row["predicted"] = p.order;
      if (p.terms) {
        row["terms"] = {{"bias_h", p.terms->bias1},
                        {"bias_h2", p.terms->bias2},
                        {"variance_h2", p.terms->variance2},
                        {"variance_h3", p.terms->variance3}};
      }
    }
    for (const QuadraturePoint& p : c.points) {
      Json point{{"samples", p.samples}, {"evaluations", p.evaluations}, {"processor_s", p.seconds}};
      for (std::size_t q = 0; q < kQuantities; ++q) {
        const QuantityError& e = p.errors[q];
        point[kQuantityNames[q]] = {{"max", e.max}, {"rms", e.rms}, {"mean", e.mean}};
      }
      curve["points"].push_back(std::move(point));
    }
    out["curves"].push_back(std::move(curve));
  }
  for (const StiffRow& s : r.stiff) {
    out["stiff"].push_back({{"rule", s.rule},
                            {"sigma", s.sigma},
                            {"colour_rms", s.error},
                            {"predicted", s.predicted ? Json(*s.predicted) : Json(nullptr)}});
  }
  for (const ThinSlabRow& s : r.thin) {
    out["thin_slabs"].push_back({{"rule", s.rule},
                                 {"width_m", s.width_m},
                                 {"interval_m", s.interval_m},
                                 {"opacity", s.opacity},
                                 {"standard_error", s.standard_error},
                                 {"expected", s.expected ? Json(*s.expected) : Json(nullptr)}});
  }
  const OrderCount orders = count_orders(r);
  out["order_ok"] = orders.held;
  out["order_compared"] = orders.compared;
  return out.dump(1) + "\n";
}

std::string quadrature_figure(const QuadratureResults& r, const RayProblem& problem) {
  std::vector<PlotSpec> panels;
  for (const bool is_double : {true, false}) {
    for (const bool by_time : {false, true}) {
      PlotSpec spec;
      spec.title = is_double ? "float64" : "float32";
      spec.x_label = by_time ? "CPU time per ray, microseconds" : "field evaluations per ray";
      spec.log_x = spec.log_y = spec.markers = true;
      spec.end_values = false;
      double low = INFINITY, high = 0;
      int color = 0;
      for (const QuadratureRule& rule : r.rules) {
        if (!drawn(rule)) continue;
        const QuadratureCurve& c = r.at(problem.key, rule.name, is_double);
        PlotSeries series;
        series.name = rule.sampler.empty() ? rule.name + " (not a sampler)" : rule.name;
        series.color = color++;
        for (const QuadraturePoint& p : c.points) {
          const double x = by_time ? 1e6 * p.seconds : p.evaluations;
          low = std::min(low, x);
          high = std::max(high, x);
          if (p.errors[0].rms >= kPlotFloor) series.points.push_back({x, p.errors[0].rms});
        }
        spec.series.push_back(std::move(series));
      }
      for (const double level : kLevels)
        spec.series.push_back({"marks: 2e-3, 1e-4, 1e-6", 7, {{low, level}, {high, level}}, {}, {}, true});
      panels.push_back(std::move(spec));
    }
  }
  return figure_svg("rms error of colour: " + problem.name, panels, 2);
}

}  // namespace semfield
