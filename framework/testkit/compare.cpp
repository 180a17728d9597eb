// Comparison of matrices.
#include "testkit/compare.h"

#include <cstdio>

#include "core/rng.h"
#include "model/param_store.h"
#include "testkit/laws.h"

namespace semfield::testkit {

std::string shown_number(double value) {
  char text[40];
  std::snprintf(text, sizeof(text), "%.9g", value);
  return text;
}

std::string shown_place(std::int64_t row, std::int32_t col) {
  char text[60];
  std::snprintf(text, sizeof(text), "element (%lld, %d)", static_cast<long long>(row), col);
  return text;
}

std::string shown_shape(std::int64_t rows, std::int32_t cols) {
  return std::to_string(rows) + " x " + std::to_string(cols);
}

std::string to_text(const Failures& failures) {
  std::string text;
  for (const std::string& failure : failures) text += failure + "\n";
  return text;
}

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

template class TensorBox<float>;
template class TensorBox<double>;

}  // namespace semfield::testkit
