// Integrals of a ray and what theory predicts of each rule, by Gauss' rule on panels.
#include <algorithm>
#include <cmath>
#include <functional>
#include <numbers>

#include "core/check.h"
#include "studies/quadrature_problems.h"

namespace semfield {

namespace {

std::array<Exact, kBenchClasses> logit_slopes_at(Exact t) { return {3 * std::cos(t), -1.5L * std::sin(t / 2), 0}; }

// Nodes and weights of Gauss' rule on [-1, 1], by Newton's method on the Legendre polynomial.
struct GaussRule {
  static constexpr int kNodes = 16;
  std::array<Exact, kNodes> node{}, weight{};
  GaussRule() {
    for (int i = 0; i < kNodes; ++i) {
      Exact x = std::cos(std::numbers::pi_v<Exact> * (i + 0.75L) / (kNodes + 0.5L)), slope = 0;
      for (int iteration = 0; iteration < 100; ++iteration) {
        Exact before = 1, p = x;
        for (int n = 2; n <= kNodes; ++n) {
          const Exact next = ((2 * n - 1) * x * p - (n - 1) * before) / n;
          before = p;
          p = next;
        }
        slope = kNodes * (x * p - before) / (x * x - 1);
        x -= p / slope;
        if (std::abs(p / slope) < 1e-19L) break;
      }
      node[static_cast<std::size_t>(i)] = x;
      weight[static_cast<std::size_t>(i)] = 2 / ((1 - x * x) * slope * slope);
    }
  }
};

const GaussRule& gauss() {
  static const GaussRule rule;
  return rule;
}

using Integrand = std::function<void(Exact t, Exact weight)>;

void over_panel(Exact from, Exact to, const Integrand& add) {
  const Exact half = (to - from) / 2, middle = (from + to) / 2;
  for (std::size_t i = 0; i < GaussRule::kNodes; ++i) add(middle + half * gauss().node[i], half * gauss().weight[i]);
}

// Panels of a piece without jumps: they double in length from its near end, as light decays there within 1/sigma.
void over_piece(const RayProblem& p, Exact shift, Exact from, Exact to, const Integrand& add) {
  const Exact tau = p.field->optical_depth(to, shift) - p.field->optical_depth(from, shift);
  constexpr int kParts = 4;
  const int levels = tau > 4 ? static_cast<int>(std::ceil(std::log2(tau))) + 1 : 0;
  Exact begin = from;
  for (int level = levels; level >= 0; --level) {
    const Exact end = from + std::ldexp(to - from, -level);
    for (int part = 0; part < kParts; ++part)
      over_panel(begin + (end - begin) * part / kParts, begin + (end - begin) * (part + 1) / kParts, add);
    begin = end;
  }
}

// Calls add(t, weight) at the nodes of a fine rule on [from, far].
void over_ray(const RayProblem& p, Exact shift, Exact from, const Integrand& add) {
  std::vector<Exact> borders{from};
  for (const Exact jump : p.field->jumps(shift)) {
    if (jump > from && jump < Exact(p.far_m)) borders.push_back(jump);
  }
  borders.push_back(p.far_m);
  for (std::size_t i = 0; i + 1 < borders.size(); ++i) {
    if (p.field->sigma((borders[i] + borders[i + 1]) / 2, shift) == 0) continue;  // vacuum shows nothing
    over_piece(p, shift, borders[i], borders[i + 1], add);
  }
}

// What one ray sees of every channel: colour, distance and logits, each with int sigma T v.
struct Channels {
  Exact color = 0, depth = 0;
  std::array<Exact, kBenchClasses> logits{};
};

// Light that reaches `from`, where transmittance counts as 1.
Channels seen_from(const RayProblem& p, Exact shift, Exact from) {
  Channels sum;
  const Exact before = p.field->optical_depth(from, shift);
  over_ray(p, shift, from, [&](Exact t, Exact weight) {
    const Exact w = weight * p.field->sigma(t, shift) * std::exp(before - p.field->optical_depth(t, shift));
    sum.color += w * p.field->color(t);
    sum.depth += w * t;
    const auto s = bench_logits(t);
    for (std::size_t j = 0; j < kBenchClasses; ++j) sum.logits[j] += w * s[j];
  });
  return sum;
}

Exact opacity_from(const RayProblem& p, Exact shift, Exact from) {
  return -std::expm1(p.field->optical_depth(from, shift) - p.field->optical_depth(p.far_m, shift));
}

// dp_0 / ds_j.
std::array<Exact, kBenchClasses> probability_slopes(std::span<const Exact> logits) {
  std::array<Exact, kBenchClasses> e{}, out{};
  Exact sum = 0;
  for (std::size_t j = 0; j < kBenchClasses; ++j) sum += e[j] = std::exp(logits[j] - logits[0]);
  for (std::size_t j = 0; j < kBenchClasses; ++j) out[j] = e[0] / sum * ((j == 0 ? 1 : 0) - e[j] / sum);
  return out;
}

// Errors are linear in what a sample shows: one channel v(t) for each quantity.
class ChannelOf {
 public:
  ChannelOf(const RayProblem& p, Quantity quantity) : p_(p), quantity_(quantity) {
    if (quantity == Quantity::probability) slopes_ = probability_slopes(seen_from(p, 0, p.near_m).logits);
  }
  Exact value(Exact t) const {
    const auto s = bench_logits(t);
    return pick(p_.field->color(t), t, 1, s);
  }
  Exact slope(Exact t) const { return pick(p_.field->color_slope(t), 1, 0, logit_slopes_at(t)); }
  // R(t): what is seen from t on.
  Exact behind(Exact t) const {
    const Channels c = seen_from(p_, 0, t);
    return pick(c.color, c.depth, quantity_ == Quantity::opacity ? opacity_from(p_, 0, t) : 0, c.logits);
  }

 private:
  Exact pick(Exact color, Exact depth, Exact opacity, const std::array<Exact, kBenchClasses>& logits) const {
    switch (quantity_) {
      case Quantity::color:
        return color;
      case Quantity::opacity:
        return opacity;
      case Quantity::depth:
        return depth;
      case Quantity::probability:
        break;
    }
    Exact sum = 0;
    for (std::size_t j = 0; j < kBenchClasses; ++j) sum += slopes_[j] * logits[j];
    return sum;
  }
  const RayProblem& p_;
  Quantity quantity_;
  std::array<Exact, kBenchClasses> slopes_{};
};

constexpr double kNothing = 1e-15;  // a constant below it is rounding

double clean(Exact value) {
  const auto rounded = static_cast<double>(value);
  return std::abs(rounded) < kNothing ? 0.0 : rounded;
}

// Terms of a smooth medium. With G = T sigma (v - R), G' = T (sigma' (v - R) + sigma v').
Prediction predict_smooth(const RayProblem& p, RuleShape shape, const ChannelOf& channel) {
  const RayField& f = *p.field;
  const Exact zero = f.optical_depth(p.near_m, 0), far = p.far_m;
  const auto transmittance = [&](Exact t) { return std::exp(zero - f.optical_depth(t, 0)); };
  const auto g_at = [&](Exact t) { return transmittance(t) * f.sigma(t, 0) * (channel.value(t) - channel.behind(t)); };
  const auto g_slope_at = [&](Exact t) {
    return transmittance(t) *
           (f.sigma_slope(t, 0) * (channel.value(t) - channel.behind(t)) + f.sigma(t, 0) * channel.slope(t));
  };
  const auto integral = [&](auto&& value) {
    Exact sum = 0;
    over_ray(p, 0, p.near_m, [&](Exact t, Exact weight) { sum += weight * value(t); });
    return sum;
  };
  const Exact near_g = g_at(p.near_m), far_g = g_at(far);
  Prediction out;
  Prediction::Terms terms;
  switch (shape) {
    case RuleShape::paper_training:
      out.order = 1;
      terms.bias1 = clean(-(7 * far_g - near_g) / 12);
      terms.variance2 = clean(near_g * near_g / 12);
      terms.variance3 = clean(integral([&](Exact t) { return g_slope_at(t) * g_slope_at(t); }) / 80);
      break;
    case RuleShape::bin_training:
      out.order = 1.5;
      terms.variance3 = clean(integral([&](Exact t) { return g_slope_at(t) * g_slope_at(t); }) / 12);
      break;
    default: {
      out.order = shape == RuleShape::midpoint ? 2 : 1;
      const Exact layers =
          integral([&](Exact t) { return transmittance(t) * channel.slope(t) * f.sigma(t, 0) * f.sigma(t, 0); });
      Exact second = (layers - (g_slope_at(far) - g_slope_at(p.near_m))) / 24;
      const Exact far_sigma = f.sigma(far, 0);
      // (sigma v)' at the far end, with the light that gets there.
      const Exact far_slope =
          transmittance(far) * (f.sigma_slope(far, 0) * channel.value(far) + far_sigma * channel.slope(far));
      if (shape == RuleShape::paper_rendering) {
        terms.bias1 = clean(-far_g / 2);
        second += (2 * far_slope - far_sigma * far_g) / 8;
      }
      if (shape == RuleShape::left) {
        terms.bias1 = clean(-(far_g - near_g) / 2);
        const Exact near_sigma = f.sigma(p.near_m, 0);
        second += (far_slope - g_slope_at(p.near_m) - near_sigma * near_g + (2 * near_sigma - far_sigma) * far_g) / 8;
      }
      terms.bias2 = clean(second);
    }
  }
  out.terms = terms;
  return out;
}

}  // namespace

PerQuantity exact_values(const RayProblem& problem, double shift) {
  const Channels c = seen_from(problem, shift, problem.near_m);
  return {c.color, opacity_from(problem, shift, problem.near_m), c.depth, class_probability(c.logits)};
}

Exact class_probability(std::span<const Exact> logits) {
  Exact sum = 0;
  for (const Exact s : logits) sum += std::exp(s - logits[0]);
  return 1 / sum;
}

bool Prediction::exact() const {
  return terms && terms->bias1 == 0 && terms->bias2 == 0 && terms->variance2 == 0 && terms->variance3 == 0;
}

double Prediction::rms(double interval) const {
  SEMFIELD_CHECK(terms.has_value(), "no terms were derived for this rule");
  const double h = interval, bias = terms->bias1 * h + terms->bias2 * h * h;
  return std::sqrt(bias * bias + terms->variance2 * h * h + terms->variance3 * h * h * h);
}

Prediction predict(const RayProblem& problem, RuleShape shape, Quantity quantity) {
  if (!problem.smooth) {
    const bool lost = shape == RuleShape::fourth && problem.stiffness * (problem.far_m - problem.near_m) > 1024;
    return {lost ? 0.0 : 1.0, {}};
  }
  if (shape == RuleShape::second) return {2, {}};
  if (shape == RuleShape::fourth) return {4, {}};
  return predict_smooth(problem, shape, ChannelOf(problem, quantity));
}

}  // namespace semfield
