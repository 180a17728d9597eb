// Rules of the rendering integral: references, the orders and constants that theory predicts, and `semfield-study
// quadrature`.
#include <nlohmann/json.hpp>
#include <regex>

#include "plugin/loader.h"
#include "studies/quadrature_bench.h"
#include "tests/program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using nlohmann::json;

const Registry& registry() {
  static const Registry* const all = [] {
    auto* r = new Registry;
    register_linked_plugins(*r);
    return r;
  }();
  return *all;
}

const QuadratureRule& rule_named(std::string_view name) {
  static const std::vector<QuadratureRule> rules = quadrature_rules(registry());
  for (const QuadratureRule& rule : rules) {
    if (rule.name == name) return rule;
  }
  throw Error(ErrorKind::failure, "test.error.made", "no rule '" + std::string(name) + "'");
}

RayProblem problem_named(const std::string& key) {
  for (RayProblem& p : quadrature_problems()) {
    if (p.key == key) return p;
  }
  throw Error(ErrorKind::failure, "test.error.made", "no problem '" + key + "'");
}

QuadratureOptions grid(std::int64_t rays, std::vector<std::int64_t> samples = {64, 128, 256, 512}) {
  QuadratureOptions options;
  options.rays = rays;
  options.samples = std::move(samples);
  return options;
}

double order(const std::string& problem, const std::string& rule, std::int64_t rays = 64,
             Quantity quantity = Quantity::color) {
  const QuadratureCurve curve = measure_rule<double>(problem_named(problem), rule_named(rule), grid(rays), registry());
  return curve.orders[static_cast<std::size_t>(quantity)].value_or(NAN);
}

TEST(QuadratureReferences, AgreeWithClosedForms) {
  const double e4 = std::exp(-4.0);
  const PerQuantity linear = exact_values(problem_named("linear_colour"), 0);
  EXPECT_NEAR(linear[0], (1 - 5 * e4) / 4, 1e-16);
  EXPECT_NEAR(linear[1], 1 - e4, 1e-16);
  EXPECT_NEAR(linear[2], 1 - 5 * e4, 1e-15);
  const PerQuantity ramp = exact_values(problem_named("linear_density"), 0);
  EXPECT_NEAR(ramp[1], 1 - std::exp(-8.0), 1e-16);
  // int t^2 e^(-t^2/2) from 0 to 4.
  EXPECT_NEAR(ramp[2], std::sqrt(M_PI / 2) * std::erf(4 / std::sqrt(2.0)) - 4 * std::exp(-8.0), 1e-15);
  for (const double sigma : {1.0, 1e3, 1e8}) {
    const PerQuantity fog = exact_values(constant_medium(sigma), 0);
    const double through = std::exp(-4 * sigma);
    EXPECT_NEAR(fog[0], (1 / sigma - (4 + 1 / sigma) * through) / 4, 1e-15 / sigma) << sigma;
  }
  // Slabs 5 and 1, moved by 0.25: colour of a slab from a to b is int sigma e^(-sigma (t - a)) t/4.
  const auto slab = [](double s, double a, double b) { return (a + 1 / s - (b + 1 / s) * std::exp(-s * (b - a))) / 4; };
  EXPECT_NEAR(exact_values(problem_named("slabs"), 0.25)[0], slab(5, 0.95, 1.55) + std::exp(-3.0) * slab(1, 2.35, 3.45),
              1e-15);
  EXPECT_NEAR(exact_values(problem_named("wall"), 0.25)[0], (1.484 + 1e-4) / 4, 1e-15);
}

TEST(QuadratureOrders, SmoothMedium) {  // A07
  EXPECT_NEAR(order("decay_cosine", "left grid"), 1, 0.05);
  EXPECT_NEAR(order("decay_cosine", "midpoint"), 2, 0.05);
  EXPECT_NEAR(order("decay_cosine", "paper, training", 1000), 1, 0.1);
  EXPECT_NEAR(order("decay_cosine", "stratified_bin", 300), 1.5, 0.2);
  EXPECT_NEAR(order("decay_cosine", "Gauss 2"), 4, 0.05);
  for (const Quantity q : {Quantity::opacity, Quantity::depth, Quantity::probability}) {
    EXPECT_NEAR(order("decay_cosine", "midpoint", 64, q), 2, 0.05);
    EXPECT_NEAR(order("decay_cosine", "paper, training", 1000, q), 1, 0.1);
    EXPECT_NEAR(order("decay_cosine", "stratified_bin", 300, q), 1.5, 0.2);
  }
}

TEST(QuadratureOrders, JumpsLeaveOrderOne) {
  for (const char* rule : {"paper, training", "midpoint", "stratified_bin"})
    EXPECT_NEAR(order("slabs", rule, 300), 1, 0.15) << rule;
  EXPECT_NEAR(order("wall", "midpoint", 300), 1, 0.1);
  EXPECT_NEAR(order("wall", "Gauss 2", 300), 0, 0.1);  // no convergence while an interval is opaque
}

// sigma = t, c = 1: nothing happens at the near end, so the whole bias is 7/6 of that of the left grid.
TEST(QuadratureConstants, JitterIsSevenSixthsOfTheLeftGrid) {  // A07
  const RayProblem ramp = problem_named("linear_density");
  const auto left = measure_rule<double>(ramp, rule_named("left grid"), grid(16, {512}), registry());
  const auto paper = measure_rule<double>(ramp, rule_named("paper, training"), grid(4000, {512}), registry());
  EXPECT_NEAR(paper.points[0].errors[0].mean / left.points[0].errors[0].mean, 7.0 / 6, 0.05 * 7 / 6);
}

// Constant density, linear colour.
TEST(QuadratureConstants, LinearColour) {  // A06
  const RayProblem p = problem_named("linear_colour");
  const double h = 4.0 / 512, lost = 1 - std::exp(-4.0);
  const auto left = measure_rule<double>(p, rule_named("left grid"), grid(16, {512}), registry());
  EXPECT_NEAR(left.points[0].errors[0].mean, -0.5 * 0.25 * lost * h, 0.05 * 0.5 * 0.25 * lost * h);
  const auto middle = measure_rule<double>(p, rule_named("midpoint"), grid(16, {512}), registry());
  EXPECT_NEAR(middle.points[0].errors[0].mean, 0.25 * h * h * lost / 12, 0.05 * 0.25 * h * h * lost / 12);
}

// The terms of docs/reference/quadrature.md, for every rule and quantity for which they were derived.
TEST(QuadratureConstants, PredictedErrorsAreMeasured) {
  for (const RayProblem& p : quadrature_problems()) {
    if (!p.smooth) continue;
    for (const char* name : {"paper, training", "paper, rendering", "midpoint", "stratified_bin", "left grid"}) {
      const QuadratureRule& rule = rule_named(name);
      // Of jittered rules the bias of order h^2 is not among the terms; it has to be small beside them.
      const auto samples = rule.training ? 1024 : 256;
      const auto curve = measure_rule<double>(p, rule, grid(rule.training ? 2500 : 16, {samples}), registry());
      for (std::size_t q = 0; q < kQuantities; ++q) {
        const Prediction& expected = curve.predictions[q];
        ASSERT_TRUE(expected.terms) << name;
        const double measured = curve.points[0].errors[q].rms;
        if (expected.exact()) {
          EXPECT_LT(measured, 1e-12) << p.key << ", " << name << ", " << kQuantityNames[q];
          continue;
        }
        const double wanted = expected.rms(4.0 / samples);
        EXPECT_NEAR(measured, wanted, 0.05 * wanted) << p.key << ", " << name << ", " << kQuantityNames[q];
      }
    }
  }
}

TEST(QuadratureStiffness, FixedRulesGiveTheirFormula) {  // A08
  for (const char* name : {"midpoint", "left grid"}) {
    for (const StiffRow& row : measure_stiffness(rule_named(name), 1, registry())) {
      ASSERT_TRUE(row.predicted);
      EXPECT_NEAR(row.error, *row.predicted, 0.01 * *row.predicted + 1e-15) << name << " at " << row.sigma;
    }
  }
  for (const char* name : {"paper, training", "stratified_bin"}) {
    int compared = 0;
    for (const StiffRow& row : measure_stiffness(rule_named(name), 6000, registry())) {
      if (!row.predicted) continue;
      ++compared;
      EXPECT_NEAR(row.error, *row.predicted, 0.05 * *row.predicted) << name << " at " << row.sigma;
    }
    EXPECT_GE(compared, 5);
  }
  for (const StiffRow& row : measure_stiffness(rule_named("linear colour"), 1, registry()))
    EXPECT_LT(row.error, 1e-15) << row.sigma;
}

TEST(QuadratureThinSlabs, JitterMeetsThemByChance) {  // A10
  int compared = 0;
  for (const ThinSlabRow& row : measure_thin_slabs(rule_named("stratified_bin"), 6000, registry())) {
    if (!row.expected) continue;
    ++compared;
    const double error = std::sqrt(*row.expected * (1 - *row.expected) / 6000);
    EXPECT_NEAR(row.opacity, *row.expected, 3 * error) << row.width_m;
  }
  EXPECT_EQ(compared, 4);
  for (const ThinSlabRow& row : measure_thin_slabs(rule_named("midpoint"), 1, registry())) {
    if (row.width_m < row.interval_m / 2) {
      EXPECT_EQ(row.opacity, 0) << row.width_m;
    }
    if (row.width_m > row.interval_m) {
      EXPECT_NEAR(row.opacity, 1, 1e-4) << row.width_m;
    }
  }
}

TEST(QuadratureBench, FloatStaysOnTheCurveUntilRounding) {
  const RayProblem p = problem_named("decay_cosine");
  const auto single = measure_rule<float>(p, rule_named("midpoint"), grid(16), registry());
  const auto twice = measure_rule<double>(p, rule_named("midpoint"), grid(16), registry());
  for (std::size_t i = 0; i < single.points.size(); ++i)
    EXPECT_NEAR(single.points[i].errors[0].rms, twice.points[i].errors[0].rms, 5e-7);
}

TEST(QuadratureBench, CrossingsAreWhereTheCurveStaysBelow) {
  QuadratureCurve curve;
  for (const auto& [n, error] : {std::pair{8.0, 1e-5}, {16.0, 1e-2}, {32.0, 1e-4}, {64.0, 1e-6}})
    curve.points.push_back({static_cast<std::int64_t>(n), n, n, {{error, error, error}}});
  const auto found = crossing(curve, Quantity::color, 1e-3);
  ASSERT_TRUE(found);
  EXPECT_NEAR(found->evaluations, 16 * std::sqrt(2.0), 1e-9);
  EXPECT_FALSE(crossing(curve, Quantity::color, 1e-7));
  EXPECT_EQ(crossing(curve, Quantity::color, 1)->evaluations, 8);
}

TEST(QuadratureVerb, WritesTablesPlotsAndJson) {
  const TempDir dir;
  const std::string& folder = dir.path();
  const auto r = testing_program::semfield_run("-q quadrature --rays 64 --out out", folder);
  const std::size_t end = r.out.find_last_not_of('\n'), begin = r.out.rfind('\n', end);
  std::smatch words;
  const std::string last = r.out.substr(begin + 1, end - begin);
  ASSERT_TRUE(
      std::regex_match(last, words, std::regex(R"(study quadrature: rules=(\d+) problems=6 order_ok=(\d+)/(\d+))")))
      << last << r.err;
  EXPECT_GE(std::stoi(words[1]), 8);
  EXPECT_GE(std::stoi(words[3]), 60);
  EXPECT_EQ(r.code == 0, words[2] == words[3]);
  EXPECT_HAS(r.out, "## Omissions", "does not converge");
  const json out = json::parse(read_text_file(folder + "/out/quadrature.json"));
  EXPECT_EQ(out["curves"].size(), 2 * 6 * std::stoul(words[1]));
  for (const json& curve : out["curves"]) {
    for (const json& point : curve["points"]) {
      EXPECT_GT(point["processor_s"], 0);
      EXPECT_LE(point["colour"]["rms"].get<double>(), point["colour"]["max"].get<double>() * (1 + 1e-12));
    }
  }
  for (const RayProblem& p : quadrature_problems())
    EXPECT_HAS(read_text_file(folder + "/out/" + p.key + ".svg"), "</svg>") << p.key;
}

}  // namespace
}  // namespace semfield
