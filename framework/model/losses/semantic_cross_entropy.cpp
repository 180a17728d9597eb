// Cross-entropy by log-sum-exp from the row maximum; sums of a row are in double.
#include "model/losses/semantic_cross_entropy.h"

#include <cmath>
#include <string>

#include "compute/math_functions.h"
#include "core/check.h"
#include "core/error.h"

namespace semfield {
namespace {

// A softmax row without the exponentials: largest logit, its class, and the sum of the others' e^(s_c - largest).
// Keeping the largest one apart leaves log1p(rest) and -rest / (1 + rest) exact for a row that is almost certain.
struct RowSum {
  double largest = 0;
  double rest = 0;
  std::int32_t argmax = 0;
};

/// The largest logit and its class; every logit is finite.
template <class Real>
RowSum top_of_row(const Real* logits, std::int32_t classes, std::int64_t ray) {
  RowSum row;
  const bool finite = all_finite(logits, classes);
  for (std::int32_t c = 0; c < classes && !finite; ++c) {
    if (!std::isfinite(logits[c])) {
      throw Error(ErrorKind::failure, "train.logit.not_finite",
                  "logit of ray " + std::to_string(ray) + ", class " + std::to_string(c) + " is " +
                      std::to_string(static_cast<double>(logits[c])) + "; it must be finite",
                  "lower the learning rate, or go back to the last checkpoint");
    }
  }
  const Real largest = largest_of(logits, classes);
  while (logits[row.argmax] != largest) ++row.argmax;  // the first of equals
  row.largest = static_cast<double>(largest);
  return row;
}

template <class Real>
RowSum sum_row(const Real* logits, std::int32_t classes, std::int64_t ray) {
  RowSum row = top_of_row(logits, classes, ray);
  for (std::int32_t c = 0; c < classes; ++c) {
    if (c != row.argmax) row.rest += std::exp(static_cast<double>(logits[c]) - row.largest);
  }
  return row;
}

/// The same with e^(s_c - largest) left in `e` [classes]: one vectorised exponential a class, for training, where the
/// gradient needs each of them again.
template <class Real>
RowSum sum_row(const Real* logits, std::int32_t classes, std::int64_t ray, Real* e) {
  RowSum row = top_of_row(logits, classes, ray);
  const Real largest = logits[row.argmax];
  for (std::int32_t c = 0; c < classes; ++c) e[c] = logits[c] - largest;
  exp_inplace(e, classes);
  row.rest = sum_of(e, row.argmax) + sum_of(e + row.argmax + 1, classes - row.argmax - 1);
  // Exponentials below the normal range of float lose digits, and so would the loss of a row that is almost certain.
  if (row.rest < 1e-30) return sum_row(logits, classes, ray);
  return row;
}

template <class Real>
double probability_of(const RowSum& row, const Real* logits, std::int32_t c) {
  return (c == row.argmax ? 1.0 : std::exp(static_cast<double>(logits[c]) - row.largest)) / (1.0 + row.rest);
}

// -log softmax(s)_c
template <class Real>
double surprise_of(const RowSum& row, const Real* logits, std::int32_t c) {
  return (row.largest - static_cast<double>(logits[c])) + std::log1p(row.rest);
}

// Sum of a soft row; throws for values that are no probabilities.
double soft_row_sum(const float* p, std::int32_t classes, std::int64_t ray) {
  double sum = 0;
  for (std::int32_t c = 0; c < classes; ++c) {
    if (!(p[c] >= 0) || std::isinf(p[c])) {
      throw Error(ErrorKind::data, "labels.probability.invalid",
                  "soft label of ray " + std::to_string(ray) + ", class " + std::to_string(c) + " is " +
                      std::to_string(p[c]) + "; probabilities are finite and not negative");
    }
    sum += static_cast<double>(p[c]);
  }
  return sum;
}

void check_label(std::int16_t label, std::int32_t classes, std::int64_t ray) {
  if (label >= -1 && label < classes) return;
  throw Error(ErrorKind::data, "labels.class.range",
              "label of ray " + std::to_string(ray) + " is " + std::to_string(label) + "; classes are 0 to " +
                  std::to_string(classes - 1) + " and void is -1",
              "check the class table against the label images");
}

double weight_of(View<const float> class_weight, std::int32_t c) {
  return class_weight.empty() ? 1.0 : static_cast<double>(class_weight(0, c));
}

// One ray: loss, label and gradient. `slope` = scale / normaliser.
template <class Real>
struct RayTerm {
  const Real* logits;
  std::int32_t classes;
  View<const float> class_weight;
  double slope;
  Real* d_logits;  // null: not wanted

  /// d_logits holds the exponentials of sum_row on entry.
  double hard(const RowSum& row, std::int32_t label) const {
    const double weight = weight_of(class_weight, label);
    if (d_logits != nullptr) {
      const double share = 1.0 / (1.0 + row.rest);
      const double of_label = static_cast<double>(d_logits[label]) * share;
      const double factor = slope * weight * share;
      for (std::int32_t c = 0; c < classes; ++c)
        d_logits[c] = static_cast<Real>(factor * static_cast<double>(d_logits[c]));
      // p_y - 1 loses its digits when p_y is almost 1; for the row's largest it is -rest / (1 + rest).
      const double gap = label == row.argmax ? 0.0 - row.rest * share : of_label - 1.0;
      d_logits[label] = static_cast<Real>(slope * weight * gap);
    }
    return weight * surprise_of(row, logits, label);
  }

  double soft(const RowSum& row, const float* target, double target_sum) const {
    double loss = 0, total = 0;
    for (std::int32_t c = 0; c < classes; ++c) {
      const double mass = weight_of(class_weight, c) * static_cast<double>(target[c]) / target_sum;
      total += mass;
      if (mass > 0) loss += mass * surprise_of(row, logits, c);
    }
    if (d_logits != nullptr) {
      for (std::int32_t c = 0; c < classes; ++c) {
        const double mass = weight_of(class_weight, c) * static_cast<double>(target[c]) / target_sum;
        d_logits[c] = static_cast<Real>(slope * (total * probability_of(row, logits, c) - mass));
      }
    }
    return loss;
  }
};

}  // namespace

double labelled_weight(const SemanticTargets& targets, View<const float> class_weight) {
  double total = 0;
  for (std::int64_t r = 0; r < targets.hard.rows; ++r) {
    const std::int16_t label = *targets.hard.row(r);
    if (label < 0) continue;
    if (!class_weight.empty()) check_label(label, class_weight.cols, r);
    total += weight_of(class_weight, label);
  }
  for (std::int64_t r = 0; r < targets.soft.rows; ++r) {
    const float* p = targets.soft.row(r);
    const double sum = soft_row_sum(p, targets.soft.cols, r);
    if (sum == 0) continue;
    if (class_weight.empty()) {
      total += 1;
      continue;
    }
    for (std::int32_t c = 0; c < targets.soft.cols; ++c)
      total += weight_of(class_weight, c) * static_cast<double>(p[c]) / sum;
  }
  return total;
}

double semantic_normaliser(SemanticNormalisation kind, double labelled_weight, std::int64_t rays) {
  switch (kind) {
    case SemanticNormalisation::mean_labelled:
      return labelled_weight;
    case SemanticNormalisation::sum:
      return 1;
    case SemanticNormalisation::mean_rays:
      return static_cast<double>(rays);
  }
  return 1;
}

template <class Real>
SemanticLoss semantic_cross_entropy(View<const Real> logits, const SemanticTargets& targets,
                                    View<const float> class_weight, double normaliser, double scale,
                                    View<Real> d_logits, std::int64_t first_ray) {
  const bool is_hard = !targets.hard.empty();
  SEMFIELD_CHECK(logits.rows == (is_hard ? targets.hard.rows : targets.soft.rows), "logits and labels differ in rows");
  SEMFIELD_CHECK(class_weight.empty() || class_weight.cols == logits.cols, "one weight a class is needed");
  SEMFIELD_CHECK(is_hard || logits.rows == 0 || targets.soft.cols == logits.cols, "soft labels need a column a class");
  SemanticLoss result;
  const double slope = normaliser > 0 ? scale / normaliser : 0.0;
  for (std::int64_t r = 0; r < logits.rows; ++r) {
    const RayTerm<Real> term{logits.row(r), logits.cols, class_weight, slope,
                             d_logits.empty() ? nullptr : d_logits.row(r)};
    const std::int64_t ray = first_ray + r;
    const double soft_sum = is_hard ? 0.0 : soft_row_sum(targets.soft.row(r), logits.cols, ray);
    const std::int16_t label = is_hard ? *targets.hard.row(r) : std::int16_t{-1};
    if (is_hard) check_label(label, logits.cols, ray);
    if (is_hard ? label < 0 : soft_sum == 0) {
      for (std::int32_t c = 0; c < logits.cols && term.d_logits != nullptr; ++c) term.d_logits[c] = 0;
      continue;
    }
    const RowSum row = is_hard && term.d_logits != nullptr ? sum_row(term.logits, logits.cols, ray, term.d_logits)
                                                           : sum_row(term.logits, logits.cols, ray);
    result.labelled += 1;
    result.sum += is_hard ? term.hard(row, label) : term.soft(row, targets.soft.row(r), soft_sum);
  }
  return result;
}

std::vector<float> inverse_log_frequency_weights(const std::vector<std::int64_t>& pixels) {
  double total = 0;
  for (const std::int64_t n : pixels) total += static_cast<double>(n);
  std::vector<float> weights;
  weights.reserve(pixels.size());
  for (const std::int64_t n : pixels) {
    const double frequency = total > 0 ? static_cast<double>(n) / total : 0.0;
    weights.push_back(static_cast<float>(1.0 / std::log(1.02 + frequency)));
  }
  return weights;
}

template <class Real>
void softmax(View<const Real> logits, View<Real> probability) {
  for (std::int64_t r = 0; r < logits.rows; ++r) {
    const RowSum row = sum_row(logits.row(r), logits.cols, r);
    for (std::int32_t c = 0; c < logits.cols; ++c) {
      probability(r, c) = static_cast<Real>(probability_of(row, logits.row(r), c));
    }
  }
}

template <class Real>
void softmax_entropy(View<const Real> logits, View<Real> entropy) {
  for (std::int64_t r = 0; r < logits.rows; ++r) {
    const RowSum row = sum_row(logits.row(r), logits.cols, r);
    double sum = std::log1p(row.rest);  // H = ln Z + sum p_c (largest - s_c)
    for (std::int32_t c = 0; c < logits.cols; ++c) {
      const double p = probability_of(row, logits.row(r), c);
      if (p > 0) sum += p * (row.largest - static_cast<double>(logits(r, c)));
    }
    *entropy.row(r) = static_cast<Real>(sum);
  }
}

// Squared colour error and its gradient.

template <class Real>
double photometric_loss(View<const Real> color, View<const float> target, double normaliser, double scale,
                        View<Real> d_color) {
  SEMFIELD_CHECK(color.rows == target.rows, "colours and targets differ in rows");
  SEMFIELD_CHECK(d_color.empty() || normaliser > 0, "the colour loss of a batch needs a positive normaliser");
  const double slope = d_color.empty() ? 0.0 : 2.0 * scale / normaliser;
  double sum = 0;
  for (std::int64_t r = 0; r < color.rows; ++r) {
    for (std::int32_t c = 0; c < 3; ++c) {
      const double error = static_cast<double>(color(r, c)) - static_cast<double>(target(r, c));
      sum += error * error;
      if (!d_color.empty()) d_color(r, c) = static_cast<Real>(slope * error);
    }
  }
  return sum;
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                \
  template SemanticLoss semantic_cross_entropy<Real>(View<const Real>, const SemanticTargets&, View<const float>, \
                                                     double, double, View<Real>, std::int64_t);                   \
  template double photometric_loss<Real>(View<const Real>, View<const float>, double, double, View<Real>);        \
  template void softmax<Real>(View<const Real>, View<Real>);                                                      \
  template void softmax_entropy<Real>(View<const Real>, View<Real>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
