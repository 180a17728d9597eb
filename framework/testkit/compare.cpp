// Comparison of matrices.
#include "testkit/compare.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <vector>

#include "core/rng.h"
#include "model/param_store.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {
std::string number(double value) {
  char text[40];
  std::snprintf(text, sizeof(text), "%.9g", value);
  return text;
}
std::string element(std::int64_t row, std::int32_t col) {
  std::string text = "element (";
  text += std::to_string(row);
  text += ", ";
  text += std::to_string(col);
  text += ")";
  return text;
}
}  // namespace

std::string to_text(const Failures& failures) {
  std::string text;
  for (const std::string& failure : failures) text += failure + "\n";
  return text;
}

template <class A, class B>
Difference difference(View<const A> got, View<const B> want) {
  Difference worst;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double a = static_cast<double>(got(r, c));
      const double b = static_cast<double>(want(r, c));
      double gap = std::abs(a - b);
      if (!std::isfinite(a) || !std::isfinite(b)) gap = std::numeric_limits<double>::infinity();
      if (std::isfinite(b)) worst.max_want = std::max(worst.max_want, std::abs(b));
      if (gap > worst.max_abs) {
        worst.max_abs = gap;
        worst.row = r;
        worst.col = c;
        worst.got = a;
        worst.want = b;
      }
    }
  }
  return worst;
}

template <class A, class B>
std::string compare(View<const A> got, View<const B> want, double tolerance, double floor) {
  const Difference worst = difference(got, want);
  const double allowed = tolerance * std::max(worst.max_want, floor);
  if (worst.max_abs <= allowed) return {};
  return element(worst.row, worst.col) + " is " + number(worst.got) + ", expected " + number(worst.want) + " (off by " +
         number(worst.max_abs) + ", allowed " + number(allowed) + ")";
}

template <class A, class B>
std::string compare_norms(View<const A> got, View<const B> want, double tolerance) {
  double off = 0, all = 0;
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const double b = static_cast<double>(want(r, c)), d = static_cast<double>(got(r, c)) - b;
      off += d * d;
      all += b * b;
    }
  }
  if (std::sqrt(off) <= tolerance * std::sqrt(all)) return {};
  return "differs by " + number(std::sqrt(off)) + " in norm, allowed " + number(tolerance * std::sqrt(all));
}

template <class A>
std::string compare_bits(View<const A> got, View<const A> want) {
  for (std::int64_t r = 0; r < want.rows; ++r) {
    for (std::int32_t c = 0; c < want.cols; ++c) {
      const A a = got(r, c);
      const A b = want(r, c);
      if (std::memcmp(&a, &b, sizeof(A)) != 0) {
        return element(r, c) + " is " + number(static_cast<double>(a)) + ", expected the same bits as " +
               number(static_cast<double>(b));
      }
    }
  }
  return {};
}

template Difference difference(View<const float>, View<const float>);
template Difference difference(View<const float>, View<const double>);
template Difference difference(View<const double>, View<const double>);
template std::string compare(View<const float>, View<const float>, double, double);
template std::string compare(View<const float>, View<const double>, double, double);
template std::string compare(View<const double>, View<const double>, double, double);
template std::string compare_norms(View<const float>, View<const float>, double);
template std::string compare_norms(View<const float>, View<const double>, double);
template std::string compare_bits(View<const float>, View<const float>);
template std::string compare_bits(View<const double>, View<const double>);
template std::string compare_bits(View<const std::int32_t>, View<const std::int32_t>);

// Central differences.

namespace {

constexpr double kStep = 1e-6;

// (f(x + h) - f(x - h)) / 2h
double central(const std::function<double()>& loss, double& x, double h) {
  const double kept = x;
  x = kept + h;
  const double above = x;
  const double f_above = loss();
  x = kept - h;
  const double below = x;
  const double f_below = loss();
  x = kept;
  return (f_above - f_below) / (above - below);
}

// Smallest |finite difference - analytic| over the three estimates; `estimate` is the one that gave it.
double gradient_gap(const std::function<double()>& loss, double& x, double analytic, double allowed, double& estimate) {
  const double coarse = central(loss, x, kStep);
  estimate = coarse;
  double gap = std::abs(coarse - analytic);
  if (gap <= allowed) return gap;
  const double half = central(loss, x, kStep / 2);
  const double candidates[] = {(4 * half - coarse) / 3, central(loss, x, kStep / 10)};
  for (const double candidate : candidates) {
    const double other = std::abs(candidate - analytic);
    if (other < gap || std::isnan(gap)) {
      gap = other;
      estimate = candidate;
    }
  }
  return gap;
}

// Elements to check: the largest |analytic|, the first, the last, then addressed random ones.
std::vector<std::int64_t> chosen_elements(View<const double> analytic, const GradientCheck& options) {
  const std::int64_t size = analytic.size();
  std::vector<std::int64_t> chosen;
  if (size <= options.max_elements) {
    for (std::int64_t i = 0; i < size; ++i) chosen.push_back(i);
    return chosen;
  }
  std::int64_t largest = 0;
  double most = -1;
  std::vector<std::int64_t> nonzero;
  for (std::int64_t i = 0; i < size; ++i) {
    const double magnitude = std::abs(analytic(i / analytic.cols, static_cast<std::int32_t>(i % analytic.cols)));
    if (magnitude > 0) nonzero.push_back(i);
    if (magnitude > most) {
      most = magnitude;
      largest = i;
    }
  }
  chosen = {largest, 0, size - 1};
  const RandomAddress address{options.seed, 0, stream_id("testkit/gradient_check")};
  for (std::uint64_t k = 0; static_cast<int>(chosen.size()) < options.max_elements; ++k) {
    // Every second draw falls on a non-zero gradient: in a sparse table most elements have none.
    const bool among_nonzero = k % 2 == 0 && !nonzero.empty();
    const std::uint64_t range = among_nonzero ? nonzero.size() : static_cast<std::uint64_t>(size);
    const std::uint64_t draw = uniform_below(address, k, range);
    chosen.push_back(among_nonzero ? nonzero[draw] : static_cast<std::int64_t>(draw));
  }
  return chosen;
}

}  // namespace

std::string check_gradient(const std::function<double()>& loss, View<double> x, View<const double> analytic,
                           const GradientCheck& options) {
  double scale = options.floor;
  for (std::int64_t r = 0; r < analytic.rows; ++r) {
    for (std::int32_t c = 0; c < analytic.cols; ++c) {
      if (!std::isfinite(analytic(r, c))) {
        return "gradient (" + std::to_string(r) + ", " + std::to_string(c) + ") is not finite";
      }
      scale = std::max(scale, std::abs(analytic(r, c)));
    }
  }
  const double allowed = options.tolerance * scale;
  double worst = 0;
  std::string sentence;
  for (const std::int64_t i : chosen_elements(analytic, options)) {
    const std::int64_t r = i / analytic.cols;
    const auto c = static_cast<std::int32_t>(i % analytic.cols);
    double estimate = 0;
    const double gap = gradient_gap(loss, x(r, c), analytic(r, c), allowed, estimate);
    if (gap <= allowed || gap < worst) continue;
    worst = gap;
    char text[200];
    std::snprintf(text, sizeof(text), "gradient (%lld, %d) is %.9g, central differences give %.9g (allowed gap %.3g)",
                  static_cast<long long>(r), c, analytic(r, c), estimate, allowed);
    sentence = text;
  }
  return sentence;
}

// Allocation and filling of test tensors.

namespace {

float initial_value(const TensorSpec& spec, std::uint64_t seed, double noise, std::uint64_t element) {
  const RandomAddress address{seed, 0, stream_id(spec.name)};
  const double declared = spec.init.low + (spec.init.high - spec.init.low) * uniform01(address, 2 * element);
  return static_cast<float>(declared + noise * (2.0 * uniform01(address, 2 * element + 1) - 1.0));
}

}  // namespace

template <class Real>
TensorBox<Real>::TensorBox(const Parametric<Real>& component, std::uint64_t seed, double noise)
    : specs_(specs_of(component)) {
  for (std::size_t i = 0; i < specs_.size(); ++i) {
    const TensorSpec& spec = specs_[i];
    const auto size = static_cast<std::size_t>(spec.rows * spec.cols);
    std::vector<Real> value(size);
    for (std::size_t e = 0; e < size; ++e) {
      value[e] = static_cast<Real>(initial_value(spec, seed, learned(i) ? noise : 0.0, e));
    }
    values_.push_back(std::move(value));
    grads_.emplace_back(has_gradient(spec.role) ? size : 0, Real(0));
  }
  for (std::size_t i = 0; i < specs_.size(); ++i) {
    value_views_.emplace_back(values_[i].data(), specs_[i].rows, specs_[i].cols);
    grad_views_.push_back(grads_[i].empty() ? View<Real>()
                                            : View<Real>(grads_[i].data(), specs_[i].rows, specs_[i].cols));
  }
  tensors_ = {value_views_, grad_views_};
}

template <class Real>
void TensorBox<Real>::fill_grads(Real value) {
  for (std::vector<Real>& grad : grads_) std::fill(grad.begin(), grad.end(), value);
}

template <class Real>
void TensorBox<Real>::add_to_grads(Real value) {
  for (std::size_t i = 0; i < grads_.size(); ++i) {
    if (!learned(i)) continue;
    for (Real& element : grads_[i]) element += value;
  }
}

template class TensorBox<float>;
template class TensorBox<double>;

}  // namespace semfield::testkit
